# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Drive the service
#
# Validate a plan, start a capture, follow it, and read a frame, over HTTP.
#
#     hairstage simulate --rig demo --state runs/rig
#     hairstage serve --rig demo --devices runs/rig/devices.toml --root runs/stage
#     HAIRSTAGE_TOKEN=$(hairstage token show) python examples/drive_service.py

# %%
import os
import time

import httpx

token = os.environ.get("HAIRSTAGE_TOKEN")
http = httpx.Client(
    base_url=os.environ.get("HAIRSTAGE_URL", "http://127.0.0.1:8331"),
    headers={"Authorization": f"Bearer {token}"} if token else None,
    timeout=60,
    trust_env=False,
)


def checked(response: httpx.Response) -> httpx.Response:
    """The response; an error is a problem document (RFC 9457) whose detail says what to do."""
    if response.is_error:
        raise SystemExit(f"{response.status_code}: {response.json()['detail']}")
    return response


# %% [markdown]
# A plan of two lights without a sweep, below the 3 Hz at which flashes need consent. Validating
# it lights nothing.

# %%
rig = checked(http.get("/rig")).json()
names = [light["name"] for light in rig["lights"][:2]]
plan = {"lights": names, "projectors": [], "sentinels": False, "rate_hz": 2.5}
cost = checked(http.post("/plans:validate", json=plan)).json()
print(f"{cost['frames']} frames, {cost['seconds']:.1f} s")

# %%
capture = checked(http.post("/captures", json={"plan": plan})).json()
while capture["state"] != "done":
    time.sleep(0.2)
    capture = checked(http.get(f"/captures/{capture['id']}")).json()
print(f"{capture['id']}: {capture['outcome']}")

# %% [markdown]
# Frames are OpenEXR files: radiance in W/(sr m²).

# %%
steps = checked(http.get(f"/captures/{capture['id']}/steps")).json()
step = next(s for s in steps if s["kind"] == "olat")
camera = rig["cameras"][0]["name"]
frame = checked(http.get(f"/captures/{capture['id']}/frames/{step['index']}/{camera}.exr"))
print(f"step {step['index']}, {step['light']}: {len(frame.content)} bytes")
http.close()
