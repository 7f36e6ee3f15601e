"""Run by Blender, or by a Python that has bpy: opens our exports, renders them, writes its own.

`python in_bpy.py JOB.json`: the job names files and views; answers on the last line of stdout.
"""

import json
import runpy
import sys
import time
from pathlib import Path

# isort: off
import bpy  # which brings the next two
import addon_utils
import mathutils
import numpy as np
# isort: on


def main(path):
    job = json.loads(Path(path).read_text())
    addon_utils.enable("cycles")
    said = {}
    for name, file in job.get("open", {}).items():
        said[name] = opened(file)
    for name, view in job.get("render", {}).items():
        said[name] = rendered(view)
    if "write" in job:
        said["write"] = written(job["write"])
    print(json.dumps(said))


def timed(work):
    """Wall and CPU seconds of `work`."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return {"seconds": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def load(file, thinner=1.0):
    """One of our exports, in a file that held nothing."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if file.endswith(".abc"):
        bpy.ops.wm.alembic_import(filepath=file)
    elif file.endswith(".usdc"):
        bpy.ops.wm.usd_import(filepath=file)
    else:
        groom = dict(np.load(Path(file) / "groom.npz"))
        groom["radius"] = groom["radius"] * thinner
        runpy.run_path(str(Path(file) / "open_in_blender.py"), run_name="opened")["build"](groom)


def opened(file):
    """What Blender finds in it: curves, points, where they lie, how thick they are, the head."""
    said = timed(lambda: load(file))
    for thing in bpy.data.objects:
        if thing.type == "CURVES" and not thing.hide_render:
            curves = thing.data
            points = values(curves, "position", "vector", 3).astype(np.float64)
            turned = np.array(thing.matrix_world)
            points = points @ turned[:3, :3].T + turned[:3, 3]
            scale = float(np.cbrt(abs(np.linalg.det(turned[:3, :3]))))
            said |= {"curves": len(curves.curves), "points": len(points), **box(points)}
            said["radius"] = float(values(curves, "radius", "value", 1).mean() * scale)
            said["attributes"] = sorted(a.name for a in curves.attributes if a.name[0] != ".")
            said["material"] = [m.name for m in curves.materials if m]
        elif thing.type == "MESH":
            turned = np.array(thing.matrix_world)
            points = np.array([v.co for v in thing.data.vertices]) @ turned[:3, :3].T
            said["head"] = box(points + turned[:3, 3])
    return said


def values(curves, name, field, width):
    attribute = curves.attributes[name]
    found = np.empty(len(attribute.data) * width, np.float32)
    attribute.data.foreach_get(field, found)
    return found.reshape(-1, width)


def box(points):
    return {"low": points.min(axis=0).tolist(), "high": points.max(axis=0).tolist()}


def rendered(view):
    """An EXR for each light, by Cycles without limits of its own on bounces or brightness."""
    load(view["groom"], view["thinner"])
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("dark")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0
    aim(scene, view)
    cycles = scene.cycles
    cycles.samples, cycles.use_denoising, cycles.use_adaptive_sampling = view["spp"], False, False
    for kind in ("max", "diffuse", "glossy", "transmission", "transparent_max"):
        setattr(cycles, f"{kind}_bounces", view["depth"])
    cycles.sample_clamp_indirect = cycles.blur_glossy = 0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 0.01
    said = {}
    for name, light in view["lights"].items():
        peak = max(light["intensity"])
        lamp = bpy.data.lights.new(name, "POINT")
        lamp.energy, lamp.shadow_soft_size = 4 * np.pi * peak, 1e-3
        lamp.color = [x / peak for x in light["intensity"]]
        placed = bpy.data.objects.new(name, lamp)
        placed.location = light["position"]
        scene.collection.objects.link(placed)
        scene.render.filepath = light["out"]
        said[name] = timed(lambda: bpy.ops.render.render(write_still=True))
        bpy.data.objects.remove(placed)
    return said


def aim(scene, view):
    """The camera of `view`: OpenCV's K, R, t."""
    k, turn, shift = (np.array(view[name]) for name in ("K", "R", "t"))
    width, height = view["size"]
    camera = bpy.data.cameras.new("view")
    placed = bpy.data.objects.new("view", camera)
    scene.collection.objects.link(placed)
    scene.camera = placed
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.T @ np.diag([1, -1, -1]), -turn.T @ shift
    placed.matrix_world = mathutils.Matrix(pose.tolist())
    camera.sensor_fit, camera.sensor_width, camera.clip_start = "HORIZONTAL", 36.0, 0.01
    camera.lens = k[0, 0] * 36.0 / width
    camera.shift_x = (width / 2 - k[0, 2] - 0.5) / width
    camera.shift_y = (k[1, 2] + 0.5 - height / 2) / width
    render = scene.render
    render.resolution_x, render.resolution_y, render.film_transparent = width, height, True
    render.image_settings.file_format = "OPEN_EXR"
    render.image_settings.color_mode, render.image_settings.color_depth = "RGBA", "32"
    scene.view_settings.view_transform = "Raw"


def written(job):
    """Blender's own exporters on the same groom: seconds."""
    load(job["groom"])
    abc, usd = job["abc"], job["usd"]
    return {
        "abc": timed(lambda: bpy.ops.wm.alembic_export(filepath=abc)),
        "usd": timed(lambda: bpy.ops.wm.usd_export(filepath=usd)),
    }


if __name__ == "__main__":
    main(sys.argv[-1])
