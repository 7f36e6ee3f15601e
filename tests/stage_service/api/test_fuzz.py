"""The live service under requests made from its own schema: no fault, and no answer beside it."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings
from serving import serving

from stage_service.api import lanes
from stage_service.api.gate import Access
from stage_service.config import RigFile
from stage_service.records.tokens import Tokens

schemathesis = pytest.importorskip("schemathesis", reason="pip install 'hairstage[dev]'")
openapi_checks = pytest.importorskip("schemathesis.specs.openapi.checks")


@schemathesis.serializer("model/obj", "image/x-exr", "application/octet-stream")  # type: ignore[misc, unused-ignore]
def as_it_is(context: Any, value: Any) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode()


OWN = "own token of the tests"
CHECKS = [
    schemathesis.checks.not_a_server_error,
    openapi_checks.status_code_conformance,
    openapi_checks.content_type_conformance,
    openapi_checks.response_headers_conformance,
    openapi_checks.response_schema_conformance,
]
"""What fits the schema may still be refused: it does not know the rig."""
ENDLESS = {"/events"}
"""Streams that end when the client does."""
LARGE = int(os.environ.get("HAIRSTAGE_FUZZ_CASES", "10000"))


@pytest.fixture
def live(
    rig_file: RigFile, tmp_path: Path, slack: int, monkeypatch: pytest.MonkeyPatch
) -> Iterator[str]:
    """The URL of a service that asks for tokens, whose captures are short."""
    monkeypatch.setattr(lanes, "DATABASE_S", lanes.DATABASE_S * slack)
    access = Access(Tokens(tmp_path / "tokens.json", OWN))
    with serving(rig_file, tmp_path / "root", access) as http:
        yield str(http.base_url).rstrip("/")


def fuzz(
    url: str, cases: int, headers: dict[str, str], number: int
) -> tuple[Counter[int], Counter[int]]:
    """How often each status was answered to so many cases, spread over all operations: where
    everybody may ask, and elsewhere."""
    document = httpx.get(f"{url}/openapi.json", timeout=600, trust_env=False).json()
    schema = schemathesis.openapi.from_dict(document)
    for_all: Counter[int] = Counter()
    others: Counter[int] = Counter()
    operations = [
        found.ok() for found in schema.get_all_operations() if found.ok().path not in ENDLESS
    ]
    assert len(operations) > 25
    for operation in operations:

        @seed(number)
        @settings(
            max_examples=-(-cases // len(operations)),
            phases=[Phase.explicit, Phase.generate],
            suppress_health_check=list(HealthCheck),
            database=None,
            deadline=None,
        )
        @given(case=operation.as_strategy())
        def check(case: Any) -> None:
            response = case.call(base_url=url, headers=headers, timeout=600)
            guarded = case.operation.definition.raw.get("security")
            (others if guarded else for_all)[response.status_code] += 1
            case.validate_response(response, checks=CHECKS)

        check()
    return for_all, others


@pytest.mark.parametrize("who", ["token", pytest.param("nobody", marks=pytest.mark.slow)])
def test_a_few_requests_of_every_kind(live, who):
    headers = {"Authorization": f"Bearer {OWN}"} if who == "token" else {}
    for_all, others = fuzz(live, 20, headers, 1)
    assert for_all.total() + others.total() >= 20
    assert set(for_all) <= {200, 400, 401, 415, 422}  # a token that is none of ours
    if who == "nobody":
        assert set(others) == {401}
    else:
        assert 401 not in others


@pytest.mark.slow
@pytest.mark.parametrize("who", ["token", "nobody"])
def test_ten_thousand_requests(live, who, capsys):
    headers = {"Authorization": f"Bearer {OWN}"} if who == "token" else {}
    found = fuzz(live, LARGE, headers, 2)
    responses = found[0] + found[1]
    with capsys.disabled():
        print(f"\n{who}: {responses.total()} requests: {dict(sorted(responses.items()))}")
