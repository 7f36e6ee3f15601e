"""The command line: help, JSON, exit codes, and what it leaves running (nothing)."""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import until

from reconstruction import (
    Camera,
    CaptureWriter,
    Light,
    Rig,
    Step,
    Strands,
    write_strands,
)
from stage_service.cli import build_parser, main
from stage_service.cli.support.children import Children
from stage_service.cli.support.commands import (
    CommandError,
    rig_path,
    run_command,
)
from stage_service.devices.ownership import Ownership
from stage_service.records.lease import RootLock

RIGS = Path(__file__).resolve().parents[3] / "stage_service" / "rigs"


def run(capsys: pytest.CaptureFixture[str], *words: Any) -> tuple[int, dict[str, Any]]:
    """Run a command with --json: its exit code and the one object on stdout."""
    code = main([*map(str, words), "--json"])
    out = capsys.readouterr().out
    assert out.count("\n") == 1, out
    return code, json.loads(out)


def leaves(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    groups = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    if not groups:
        yield parser.prog, parser
    for group in groups:
        for child in group.choices.values():
            yield from leaves(child)


def test_every_command_has_help_and_json_output():
    commands = dict(leaves(build_parser()))
    names = {" ".join(name.split()[1:]) for name in commands}
    assert {"demo", "serve", "worker", "simulate", "verify", "import"} <= names
    assert {"reconstruct", "fit", "render", "bench"} <= names
    assert {"evaluate geometry", "rig check"} <= names
    assert {"capture start", "capture abort", "jobs submit", "jobs cancel"} <= names
    for name, parser in commands.items():
        assert parser.get_default("json") is False, name
        assert callable(parser.get_default("run")), name
        assert len(parser.description or "") > 12, name
        assert len(parser.format_help().splitlines()) > 5, name
        assert "(default: None)" not in parser.format_help(), name


def test_help_is_fast_because_nothing_heavy_is_imported():
    code = (
        "import sys; from stage_service.cli import build_parser; build_parser().format_help();"
        "print([m for m in ('numpy', 'cv2', 'mitsuba', 'dbos', 'fastapi') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_output_of_libraries_is_no_part_of_a_result(capsys):
    def noisy(args, output):
        print("Warning: a binding's own")
        output.result({"found": 1})

    parser = argparse.ArgumentParser()
    parser.set_defaults(run=noisy, json=True)
    assert run_command(parser, []) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out) == {"found": 1}
    assert "Warning" in shown.err


@pytest.mark.parametrize("debug", [False, True])
def test_a_fault_is_one_sentence_with_its_traceback_in_a_file(capsys, tmp_path, monkeypatch, debug):
    def faulty(args, output):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    parser = argparse.ArgumentParser()
    parser.set_defaults(run=faulty, json=False, debug=debug)
    assert run_command(parser, []) == 1
    first, *rest = capsys.readouterr().err.splitlines()
    assert first.startswith("hairstage: a fault of hairstage, report it with ")
    assert first.endswith("ZeroDivisionError: division by zero")
    files = list(tmp_path.iterdir())
    traceback = rest if debug else files[0].read_text().splitlines()
    assert "Traceback (most recent call last):" in traceback
    assert bool(rest) == debug == (not files)


@pytest.mark.parametrize("found", [False, True])
def test_gpu_runs_on_cuda_or_is_refused_with_what_to_do(capsys, monkeypatch, found):
    monkeypatch.setattr("drjit.has_backend", lambda backend: found)
    monkeypatch.delenv("HAIRSTAGE_VARIANT", raising=False)
    monkeypatch.setattr("os.environ", dict(os.environ))
    args = build_parser().parse_args(["fit", "capture", "model", "--gpu"])
    args.run = lambda args, output: print(os.environ["HAIRSTAGE_VARIANT"])
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", lambda self, given: args)
    assert run_command(argparse.ArgumentParser(), []) == (0 if found else 1)
    said = capsys.readouterr().err
    expected = "running on the GPU (cuda_ad_rgb)\ncuda_ad_rgb\n" if found else "without --gpu"
    assert expected in said


def test_wrong_usage_is_exit_code_2(capsys):
    with pytest.raises(SystemExit) as error:
        main(["reconstruct"])
    assert error.value.code == 2
    with pytest.raises(SystemExit) as error:
        main(["--help"])
    assert error.value.code == 0
    assert "exit codes" in capsys.readouterr().out


def test_invalid_service_options_are_refused_before_a_device_is_queried(
    capsys, tmp_path, monkeypatch
):
    def never(*_: object, **_more: object) -> None:
        raise AssertionError("a service was made")

    monkeypatch.setattr("stage_service.service.Service", never)
    root, junk = tmp_path / "root", tmp_path / "junk.pem"
    junk.write_text("no certificate")
    for words, why in (
        (["--tls-cert", tmp_path / "none.pem"], "none.pem: no such file"),
        (["--tls-cert", junk, "--tls-key", junk], "not a certificate with its key"),
        (["--tls-key", junk], "--tls-key needs --tls-cert"),
    ):
        code, data = run(capsys, "serve", "--rig", "demo", "--root", root, *words)
        assert code == 3
        assert why in data["error"]["detail"]


@pytest.mark.parametrize("name", ["demo.toml", "stage331.toml"])
def test_rig_check_counts_and_conditions(capsys, name):
    code, data = run(capsys, "rig", "check", RIGS / name)
    assert rig_path(name.removesuffix(".toml")).samefile(RIGS / name)
    assert code == 0
    assert (data["lights"], data["projectors"]) == (331, 3)
    assert data["cameras"] == {"demo.toml": 8, "stage331.toml": 50}[name]
    assert data["cost"]["frames"] == data["cost"]["steps"] * data["cameras"]
    pairs = data["triangulation"]["pairs"]
    assert len(pairs) == 3 * data["cameras"]
    assert 0.5 < data["triangulation"]["triangulated"] <= 1.0
    assert data["warnings"] == [] or name == "stage331.toml"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--environment", "nowhere.hdr"), "nowhere.hdr: no such environment map"),
        (("--field-options", '{"spp": 4}'), "--field-options needs --field"),
    ],
)
def test_a_fit_says_what_it_cannot_use_before_it_begins(capsys, words, said):
    code, data = run(capsys, "fit", "c", "m", "--hold-out-light", "l3", *words)
    assert code == 3
    assert said in data["error"]["detail"]


def test_bad_input_is_exit_code_3_and_named(capsys, tmp_path):
    code, data = run(capsys, "rig", "check", tmp_path / "none.toml")
    assert code == 3
    assert "none.toml" in data["error"]["detail"]
    code, data = run(capsys, "reconstruct", tmp_path, "--out", tmp_path / "model")
    assert code == 3
    assert "is not a capture" in data["error"]["detail"]
    (tmp_path / "mine.txt").write_text("precious")
    code, data = run(capsys, "demo", "--out", tmp_path, "--rig", RIGS / "demo.toml")
    assert code == 3
    assert "no demo wrote" in data["error"]["detail"]
    assert (tmp_path / "mine.txt").read_text() == "precious"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--seed", "-1"), "--seed -1: expected 0 or more"),
        (("--subject", "curlyy"), "--subject curlyy: "),
        (("--head", "none.obj"), "wavy-mixed brings its own"),
        (("--environment", "nosuch"), "nosuch: no such environment map"),
        (("--subject", "{tmp}/broken.npz", "--head", "none.obj"), "broken.npz"),
    ],
)
def test_a_word_that_is_wrong_costs_no_earlier_demo(capsys, tmp_path, monkeypatch, words, said):
    def prepared(out: Path) -> None:
        raise AssertionError("what was there would be gone")

    monkeypatch.setattr("stage_service.cli.demo._prepare", prepared)
    (tmp_path / "broken.npz").write_bytes(b"PK")
    code, data = run(capsys, "demo", "--out", tmp_path, *(w.format(tmp=tmp_path) for w in words))
    assert code == 3
    assert said in data["error"]["detail"]


def test_an_unreachable_service_is_exit_code_4(capsys):
    code, data = run(capsys, "capture", "list", "--url", "http://127.0.0.1:9")
    assert code == 4
    assert "hairstage serve" in data["error"]["detail"]


def test_reconstruct_reports_its_cost(capsys, tmp_path):
    cameras = [
        Camera.look_at(name, 40, 30, (x, -1, 0), (0, 0, 0), 20.0)
        for name, x in (("left", -0.2), ("right", 0.2))
    ]
    lights = [Light(n, np.array([x, -1.0, 1]), np.ones(3)) for n, x in (("a", 0), ("b", 1))]
    steps = [Step(k, "olat", 0.01, light=light.name) for k, light in enumerate(lights)]
    writer = CaptureWriter.create(
        tmp_path / "c", Rig("r", tuple(cameras), tuple(lights)), {"steps": steps}
    )
    for step in steps:
        for camera in cameras:
            writer.write_frame(step, camera.name, np.ones((30, 40, 3), np.float32))
    writer.finish("completed")
    before = sorted(tmp_path.rglob("*"))
    code, data = run(capsys, "reconstruct", tmp_path / "c", "--estimate", "--reduce", "2")
    assert code == 0
    assert (data["reduced"], data["method"], data["frames"]) == (2, "hull", 4)
    assert data["seconds"] == pytest.approx(sum(s["seconds"] for s in data["stages"]))
    assert data["peak_gb"] == max(s["peak_gb"] for s in data["stages"])
    assert data["working_gb"] == pytest.approx(4 * 20 * 15 * 13e-9)
    assert main(["reconstruct", str(tmp_path / "c"), "--estimate"]) == 0
    shown = capsys.readouterr().out
    assert "orientation" in shown
    # 2 x 1.02 m x tan(10 degrees) / 40 pixels
    assert "Pixels of 9 mm: hairs closer than 18 mm cannot be separated." in shown
    assert sorted(tmp_path.rglob("*")) == before
    code, data = run(capsys, "reconstruct", tmp_path / "c", "--estimate", "--reduce", "31")
    assert code == 3
    assert "40x30 pixels cannot be reduced by 31" in data["error"]["detail"]
    code, data = run(capsys, "reconstruct", tmp_path / "c")
    assert code == 3
    assert "--out" in data["error"]["detail"]
    for to in (("--estimate",), ("--out", tmp_path / "m")):
        code, data = run(capsys, "reconstruct", tmp_path / "c", *to, "--hold-out-light", "nope")
        assert code == 3
        assert "no light nope; its 2 are a, b" in data["error"]["detail"]


def test_evaluate_geometry_prints_the_thresholds(capsys, tmp_path):
    z = np.linspace(0, 0.1, 50)
    strands = [np.stack([np.full(50, x), np.zeros(50), z], axis=1) for x in (0.0, 0.02)]
    write_strands(tmp_path / "true.npz", Strands.from_list(strands))
    write_strands(tmp_path / "half.npz", Strands.from_list(strands[:1]))
    code, data = run(capsys, "evaluate", "geometry", tmp_path / "half.npz", tmp_path / "true.npz")
    assert code == 0
    assert "visible" not in data
    assert set(data["all"]) == {"1mm_10deg", "2mm_20deg", "3mm_30deg"}
    figures = data["all"]["1mm_10deg"]
    assert figures["precision"] == 1.0
    assert figures["recall"] == pytest.approx(0.5, abs=0.02)
    consistency = data["connectivity"]["true"]["strand_consistency"]
    assert consistency == dict.fromkeys(data["all"], 0.5)
    assert main(["evaluate", "geometry", *[str(tmp_path / "true.npz")] * 2]) == 0
    printed = capsys.readouterr().out
    assert printed.count("100.0 / 100.0 / 100.0") >= 9
    assert "equal length" in printed
    assert "root to tip" in printed
    consistency = next(line for line in printed.splitlines() if "strand consistency" in line)
    assert consistency.count("100.0") == 3


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (
            "fit c m --field additive --field-options {tmp}/list.json",
            "list.json: expected an object",
        ),
        ("fit c m --options {tmp}/bytes", "bytes is not JSON"),
        ("fit c m --options steps=3", "steps=3: no such file; give a JSON object"),
        (
            'fit c m --field additive --field-options \'{{"field": "none"}}\'',
            "use --field",
        ),
        ("rig check demo --radius nan", "radius > 0"),
        ("head mark {tmp}/bytes --out {tmp}/h.obj", "bytes is no Wavefront OBJ"),
        ("head fit {tmp}/bytes --out {tmp}/h.obj --turn-deg inf", "--turn-deg inf: expected"),
        ("export m --to usd --out {tmp}/a.usdc --cards 9", "--cards is for --to gltf, not usd"),
        ("export m --to hair --out {tmp}/a.hair --guides 9", "--guides is for --to usd or houdini"),
        ("export m --to maps --out {tmp}/a --environment sky", "--environment is for --to mitsuba"),
        ("capture start --options '{{}}'", "name it with --pipeline"),
        ("queue add --options '{{}}'", "name it with --pipeline"),
        ("store upload anna --head {tmp}/bytes --masks {tmp}/absent", "<camera>.png in it"),
        ("render m --from-frames c --field none", "--from-frames cannot be combined with --field"),
        ("render m --from-frames c --capture d", "leave out --capture"),
        ("calibrate rig c --truth {tmp}/absent.json --out {tmp}/r.json", "absent.json: no such"),
        ("calibrate board {tmp}/b.xyz", "b.xyz: expected a file ending in .png"),
        ("calibrate board {tmp}/b.png --dpi inf", "--dpi inf: "),
    ],
)
def test_invalid_input_is_named_in_one_sentence_before_any_work(capsys, tmp_path, command, said):
    (tmp_path / "list.json").write_text("[1]")
    (tmp_path / "bytes").write_bytes(b"\xff\xfe")
    code, data = run(capsys, *shlex.split(command.format(tmp=tmp_path)))
    assert code == 3
    assert said in data["error"]["detail"]


def test_wrong_unit_is_reported_before_the_evaluation_ends(capsys, tmp_path, monkeypatch):
    line = np.array([[0, 0, 0], [0, 0, 0.1]])
    write_strands(tmp_path / "true.npz", Strands.from_list([line]))
    write_strands(tmp_path / "mm.npz", Strands.from_list([1e3 * line]))

    def endless(*_args, **_more):
        raise KeyboardInterrupt

    monkeypatch.setattr("reconstruction.evaluation.assessment.assess_strands", endless)
    assert (
        main(["evaluate", "geometry", *(str(tmp_path / f"{n}.npz") for n in ("mm", "true"))]) == 130
    )
    assert "both are in metres" in capsys.readouterr().err


def test_evaluate_geometry_leaves_a_models_report_alone(capsys, tmp_path):
    model, hair = tmp_path / "model", Strands.from_list([np.array([[0, 0, 0.1], [0, 0, 0.2]])])
    model.mkdir()
    write_strands(model / "strands.npz", hair)
    (model / "report.json").write_text('{"stages": []}')
    strands = model / "strands.npz"
    code, data = run(capsys, "evaluate", "geometry", strands, strands, "--out", model)
    assert (code, "choose another folder" in data["error"]["detail"]) == (3, True)
    assert (model / "report.json").read_text() == '{"stages": []}'


@pytest.mark.slow
def test_evaluate_geometry_fills_a_folder_and_reports_bad_input(capsys, tmp_path):
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(200, 3))
    roots *= 0.09 / np.linalg.norm(roots, axis=1, keepdims=True)
    hair = Strands.from_list([np.stack([r, 1.4 * r]) for r in roots])
    write_strands(tmp_path / "true.npz", hair)
    metres = hair.subset(np.arange(20))
    write_strands(tmp_path / "mm.npz", Strands(1e3 * metres.points, metres.offsets))
    write_strands(tmp_path / "none.npz", Strands.from_list([]))
    np.savez(tmp_path / "nan.npz", points=hair.points * np.nan, offsets=hair.offsets)
    (tmp_path / "empty.hair").touch()

    command = "evaluate", "geometry"
    true, out = tmp_path / "true.npz", tmp_path / "out"
    code, data = run(capsys, *command, true, true, "--seed", -1)
    assert (code, data["error"]["detail"]) == (3, "--seed -1: expected 0 or more")
    code, data = run(capsys, *command, true, true, "--out", out)
    assert (code, data["warnings"]) == (0, [])
    assert json.loads((out / "report.json").read_text()) == data
    assert {p.name for p in out.glob("*.png")} == {Path(p).name for p in data["pictures"]}
    assert len(data["pictures"]) == 2

    code, data = run(capsys, *command, tmp_path / "mm.npz", true)
    assert code == 0
    assert "both are in metres" in data["warnings"][0]
    code, data = run(capsys, *command, tmp_path / "none.npz", true)
    assert code == 0
    assert data["warnings"] == ["there are no predicted strands: precision is 0"]
    assert data["all"]["3mm_30deg"]["f"] == 0
    for pred, other, said in [
        (true, tmp_path / "none.npz", "none.npz: no strands"),
        (tmp_path / "nan.npz", true, "nan.npz: points must be finite"),
        (tmp_path / "empty.hair", true, "empty.hair: 0 bytes"),
        (tmp_path / "absent.npz", true, "absent.npz: no such file"),
        (tmp_path / "hair.obj", true, "unknown strand format '.obj'"),
    ]:
        code, data = run(capsys, *command, pred, other)
        assert code == 3
        assert said in data["error"]["detail"]
        assert "\n" not in data["error"]["detail"]


def test_lamps_are_put_off_where_the_service_cannot_have_its_root(
    capsys, rig_file, world, tmp_path
):
    (tmp_path / "file").touch()
    world.lit, world.show = {1, 2}, "ON 65535"
    code, data = run(
        capsys, "serve", "--rig", rig_file.path, "--root", tmp_path / "file" / "root", "--port", "0"
    )
    assert (code, world.lit, world.show) == (1, set(), "OFF")
    assert "Not a directory" in data["error"]["detail"]
    assert "every lamp and projector was read back dark" in data["error"]["detail"]
    world.lit = {1, 2}
    other = Ownership(rig_file.devices.lights, tmp_path / "other")
    try:
        code, data = run(
            capsys, "serve", "--rig", rig_file.path, "--root", tmp_path / "file" / "root"
        )
    finally:
        other._lock.release()
    assert (code, world.lit) == (1, {1, 2})
    assert "left as they are" in data["error"]["detail"]
    assert "held by" in data["error"]["detail"]
    world.lit = {1, 2}  # that root has a service already: what it does with the stage is its own
    lock = RootLock(tmp_path)
    try:
        code, data = run(capsys, "serve", "--rig", rig_file.path, "--root", tmp_path, "--port", "0")
    finally:
        lock.release()
    assert (code, world.lit) == (3, {1, 2})
    assert "is in use by the service" in data["error"]["detail"]


def test_a_service_from_the_command_line(capsys, rig_file, world, tmp_path):
    command = [sys.executable, "-m", "stage_service.cli", "serve", "--json", "--port", "0"]
    command += ["--rig", str(rig_file.path), "--root", str(tmp_path / "root")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service:
        try:
            assert service.stdout is not None
            url = json.loads(service.stdout.readline())["url"]
            assert url.startswith("http://127.0.0.1:")
            plan = tmp_path / "plan.json"
            plan.write_text('{"lights": ["light_003"], "projectors": []}')
            code, cost = run(capsys, "capture", "check", "--plan", plan, "--url", url)
            assert (code, cost["steps"]) == (0, 5)
            code, data = run(capsys, "capture", "start", "--plan", plan, "--wait", "--url", url)
            assert (code, data["capture"]["outcome"]) == (0, "completed")
            capture = data["capture"]["id"]
            assert run(capsys, "verify", data["capture"]["path"])[0] == 0
            code, data = run(capsys, "capture", "list", "--url", url)
            assert [c["id"] for c in data["captures"]] == [capture]
            code, data = run(capsys, "capture", "resume", capture, "--url", url)
            assert (code, data["error"]["problem"]["status"]) == (1, 409)
            code, job = run(
                capsys, "jobs", "submit", capture, "--options", '{"seed": 4}', "--url", url
            )
            assert (code, job["state"], job["options"]["seed"]) == (0, "queued", 4)
            code, job = run(capsys, "jobs", "cancel", job["id"], "--url", url)
            assert (code, job["outcome"]) == (0, "cancelled")
            code, data = run(capsys, "jobs", "wait", job["id"], "--url", url)
            assert (code, data["job"]["outcome"]) == (1, "cancelled")
            plan.write_text('{"lights": ["lamp"]}')
            code, data = run(capsys, "capture", "start", "--plan", plan, "--url", url)
            assert (code, data["error"]["problem"]["type"]) == (3, "/docs/errors.md#invalid-plan")
            # A command that waits and is stopped in mid-capture: dark, aborted, its id.
            plan.write_text('{"rate_hz": 8, "projectors": [], "stepping": "software"}')
            for number, ends in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
                words = ["capture", "start", "--wait", "--json", "--url", url, "--plan", str(plan)]
                waits = [sys.executable, "-m", "stage_service.cli", *words]
                with subprocess.Popen(waits, stdout=subprocess.PIPE, text=True) as waiting:
                    until(lambda: world.lit)
                    waiting.send_signal(number)
                    out, _ = waiting.communicate(timeout=60)
                assert (waiting.returncode, world.lit) == (ends, set())
                code, data = run(capsys, "capture", "list", "--url", url)
                newest = data["captures"][-1]
                assert newest["outcome"] == "aborted"
                assert f"resume {newest['id']}' shoots" in json.loads(out)["error"]["detail"]
                assert run(capsys, "lease", "show", "--url", url)[1]["holder"] is None
            # SIGTERM in mid-capture: dark, a manifest that says so, exit code 0.
            world.busy["cam_0"] = 10**9
            code, data = run(capsys, "capture", "start", "--url", url)
            assert code == 0
            service.send_signal(signal.SIGTERM)
            assert service.wait(20) == 0
            assert not world.lit
            manifest = json.loads((Path(data["path"]) / "manifest.json").read_text())
            assert manifest["outcome"] == "aborted"
        finally:
            service.kill()


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_children_end_with_their_command_and_their_last_output_is_reported(tmp_path):
    sleeper = [sys.executable, "-c", "import time; print('{}', flush=True); time.sleep(60)"]
    failing = [sys.executable, "-c", "raise SystemExit('no such camera')"]
    pids = []

    def command() -> None:
        with Children(tmp_path) as children:
            child = children.start("good", sleeper, pipe=True)
            pids.append(child.pid)
            assert children.first_line("good", child, 10) == {}
            children.first_line("bad", children.start("bad", failing, pipe=True), 10)

    with pytest.raises(CommandError, match=r"bad: ended with exit code 1; .*no such camera"):
        command()
    assert not alive(pids[0])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_child_ends_with_a_command_that_is_interrupted_at_its_start(
    monkeypatch, tmp_path, number
):
    popen, begun = subprocess.Popen, []

    def interrupted(*args: Any, **kwargs: Any) -> subprocess.Popen[str]:
        begun.append(popen(*args, **kwargs))
        signal.raise_signal(number)
        return begun[0]

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", interrupted)
    before = signal.signal(number, interrupt)
    try:
        with pytest.raises(KeyboardInterrupt), Children(tmp_path) as children:
            children.start("x", [sys.executable, "-c", "import time; time.sleep(60)"])
        assert signal.getsignal(number) is interrupt
    finally:
        signal.signal(number, before)
    assert not alive(begun[0].pid)


def test_children_end_where_their_command_is_killed(tmp_path):
    if shutil.which("setpriv") is None:
        pytest.skip("there is no setpriv here: children outlive a command that is killed")
    sleeper = "import time; print('here', flush=True); time.sleep(60); print('survived')"
    program = (
        "import sys, time; from pathlib import Path\n"
        "from stage_service.cli.support.children import Children\n"
        "with Children(Path(sys.argv[1])) as children:\n"
        "    children.start('x', [sys.executable, '-c', sys.argv[2]], to_log=False)\n"
        "    time.sleep(60)\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path), sleeper]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout.readline() == "here\n"
        parent.kill()
        assert parent.stdout.read() == ""  # ends when nobody holds it any more


def test_a_plan_is_checked_without_a_service(capsys, tmp_path):
    words = ("capture", "check", "--rig", RIGS / "stage331.toml")
    code, cost = run(capsys, *words)
    assert (code, cost["frames"]) == (0, 50 * (331 + 3 * (768 + 76) + 4))
    assert main([*map(str, words)]) == 0
    shown_text = capsys.readouterr().out
    assert "limited by link" in shown_text
    assert "the trigger box clocks 2867 of 2867 steps" in shown_text
    assert "needs consent, or rate_hz" in shown_text
    plan = tmp_path / "plan.json"
    plan.write_text('{"lights": ["lamp"]}')
    code, data = run(capsys, *words, "--plan", plan)
    assert (code, "'lamp'" in data["error"]["detail"]) == (3, True)
    plan.write_text('{"speed": 1}')
    code, data = run(capsys, *words, "--plan", plan)
    assert (code, data["error"]["detail"]) == (
        3,
        f"{plan}: plan.speed: Extra inputs are not permitted, got 1",
    )


def test_a_plan_of_patterns_from_a_table_is_checked(capsys, tmp_path):
    """Light 7 of the table is light_007 of the rig; what is off is not sent."""
    words = ("capture", "check", "--rig", RIGS / "stage331.toml", "--patterns")
    table = tmp_path / "table.csv"
    table.write_text("pattern,light_000,7\nleft,1,0\nboth,0.5,1\n")
    code, cost = run(capsys, *words, table, "--plan", '{"projectors": []}')
    assert (code, cost["frames_by_kind"]["pattern"]) == (0, 50 * 2)
    code, cost = run(capsys, *words, "gradients", "--plan", '{"projectors": []}')
    assert (code, cost["frames_by_kind"]["pattern"]) == (0, 50 * 7)
    table.write_text("pattern,lamp\nleft,1\n")
    code, data = run(capsys, *words, table)
    assert (code, "there is no light 'lamp'" in data["error"]["detail"]) == (3, True)
    code, data = run(capsys, *words, tmp_path / "s_matrix.txt")
    assert (code, "expected a table of patterns (.csv, .json)" in data["error"]["detail"]) == (
        3,
        True,
    )
