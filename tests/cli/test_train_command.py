import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import orbax.checkpoint as ocp
import pytest

from samples import fast_run, made_up
from vsearch_jax.cli.main import main
from vsearch_jax.config import Config
from vsearch_jax.film import video
from vsearch_jax.runs import checkpoint, loop
from vsearch_jax.runs.folder import RunError, lock_folder, read_config, read_seed
from vsearch_jax.runs.metrics_log import STAGES, MetricsLog, read_metrics

ROOT = Path(__file__).resolve().parent.parent
STANDIN = str(ROOT / "tests" / "standin.py")


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stand-in for init, train and evaluate, without its pauses."""
    for name in ("init", "train", "evaluate", "record_search"):
        monkeypatch.setattr(loop, name, getattr(fast_run, name))
    monkeypatch.setattr(fast_run, "CHUNK_SECONDS", 0.0)


def fails(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Runs the command, which is to fail as a user's error does, and returns its one line."""
    with pytest.raises(SystemExit) as exit_:
        main.main(arguments)
    captured = capsys.readouterr()
    assert exit_.value.code == 2
    assert captured.err.startswith("vsearch: error: ") and captured.err.count("\n") == 1, captured.err
    return captured.err


def program(*arguments: str) -> dict[str, Any]:
    """What subprocess needs to run a program; XLA is not to comment on the cache's entries nor on a slow machine."""
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment["TF_CPP_MIN_LOG_LEVEL"] = "3"
    return {"args": [sys.executable, *arguments], "env": environment, "text": True}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def stored_state(run: Path) -> dict[str, np.ndarray]:
    step = checkpoint.latest_step(run)
    with ocp.CheckpointManager(run / "checkpoints") as manager:
        arguments = ocp.args.Composite(state=ocp.args.StandardRestore())
        return {name: np.asarray(value) for name, value in manager.restore(step, args=arguments)["state"].items()}


def without_times(run: Path) -> list[dict[str, Any]]:
    return [{key: value for key, value in line.items() if key != "seconds"} for line in read_metrics(run)]


def test_help_comes_without_jax() -> None:
    code = "import sys; sys.argv = ['vsearch', 'train', '--help']\nfrom vsearch_jax.cli.main import main\n"
    code += "try: main()\nexcept SystemExit as e: print('jax' in sys.modules, e.code)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False 0"
    for option in ("--preset", "--object", "--arm", "--input", "--resume", "--sac.num-seeds", "--encoder.num-updates"):
        assert option in done.stdout


def test_options_change_the_preset() -> None:
    options = "--preset smoke --out x --object truck --input depth --sac.num-seeds 4 --encoder.channels 4 8"
    command = main.parse(["train", *options.split()])
    assert isinstance(command, main.Train)
    config = command.config
    assert (config.scene.object, config.encoder.input, config.sac.num_seeds) == ("truck", "depth", 4)
    assert config.encoder.channels == (4, 8)
    assert config.sac.num_envs == Config.preset("smoke").sac.num_envs


def test_paths_are_made_absolute(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    command = main.parse(["train", "--out", "x", "--object", "part.stl", "--scene.arm", "arms/own.xml"])
    assert isinstance(command, main.Train)
    assert command.config.scene.object == str(tmp_path / "part.stl")
    assert command.config.scene.arm == str(tmp_path / "arms" / "own.xml")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "train, eval, export, reach, video"),
        ("bogus", "bogus"),
        ("train", "--out"),
        ("train --out {out} --preset huge", "unknown preset 'huge'; allowed: smoke, cpu, thesis, gpu"),
        ("train --out {out} --encoder.num-updates 0", "EncoderConfig.num_updates is 0; allowed: greater than 0"),
        ("train --out {out} --encoder.num-updates many", "--encoder.num-updates: invalid literal for int.* 'many'"),
        ("train --out {out} --input infrared", "infrared"),
        ("train --out {out} --bogus 1", "--bogus"),
        ("train --out {out} --resume", "no run in"),
        ("eval {out}", "no run in .*config.json is missing"),
        ("export {out} --out {out}2", "no run in"),
        ("video {out} --out {out}.mp4", "no run in"),
        ("reach --out {out} --radius -1", "SceneConfig.radius is -1"),
        ("reach --out {out} --mesh-scale 0", "SceneConfig.mesh_scale is 0"),
    ],
)
def test_a_users_error_is_one_line_and_makes_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: str, message: str
) -> None:
    assert re.search(message, fails(capsys, *arguments.format(out=tmp_path / "run").split()))
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("option", "message"),
    [("--object nothing", "unknown object 'nothing'"), ("--arm {out}/own.xml", "arm file .*own.xml' does not exist")],
)
def test_what_cannot_be_built_leaves_the_folder_empty(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, option: str, message: str
) -> None:
    out = tmp_path / "run"
    command = f"train --preset smoke --out {out} {option.format(out=tmp_path)}"
    assert re.search(message, fails(capsys, *command.split()))
    assert not any(out.iterdir())


def test_a_run_makes_all_of_its_folder(quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "deep" / "run"
    main.main(["train", "--preset", "smoke", "--out", str(out), "--sac.num-seeds", "2"])
    config = read_config(out)
    assert config.sac.num_seeds == 2
    lines = read_metrics(out)
    assert [line["iteration"] for line in lines] == list(range(config.num_iterations))
    assert all(("encoder_loss" in line) == (line["stage"] == "encoder") for line in lines)
    assert all(("reward" in line) == (line["stage"] == "policy") for line in lines)
    assert checkpoint.latest_step(out) == config.num_iterations
    assert {path.name for path in out.iterdir()} == {
        "checkpoints",
        "config.json",
        "figures",
        "metrics.jsonl",
        "report.html",
        "results.json",
        "tensorboard",
    }
    results = json.loads((out / "results.json").read_text())
    assert len(results["sac"]["seeds"]) == 2
    assert set(results["wall_seconds"]) == {*STAGES, "evaluation"}
    printed = capsys.readouterr().out
    assert "Soft actor-critic" in printed and f"{config.num_iterations}/{config.num_iterations} policy" in printed


def test_a_folder_that_exists_is_never_reused(quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    assert "exists; name another folder" in fails(capsys, "train", "--preset", "smoke", "--out", str(out))
    assert contents(out) == {"notes.txt": b"mine"}


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--sac.discount", "0.5", "sac.discount is 0.9 there and 0.5 here"),
        ("--evaluation.target-elevation-deg", "89", "target_elevation_deg is 89"),
    ],
)
def test_resume_with_what_the_run_cannot_do_names_it_and_changes_nothing(
    quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path, option: str, value: str, expected: str
) -> None:
    out = str(tmp_path / "run")
    main.main(["train", "--preset", "smoke", "--out", out])
    before = contents(tmp_path)
    assert expected in fails(capsys, "train", "--out", out, "--resume", option, value)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("is_target", [True, False])
def test_what_is_out_of_reach_comes_with_the_map(
    quick: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    is_target: bool,
) -> None:
    out = tmp_path / "run"
    options = ["--preset", "smoke", "--evaluation.target-elevation-deg", "89"]
    if not is_target:
        some = made_up.reach()
        nothing = dataclasses.replace(some, is_reachable=some.is_reachable & False, band=np.nan * some.band)
        monkeypatch.setattr(loop, "init", lambda *args: dataclasses.replace(fast_run.init(*args), reach=nothing))
    message = fails(capsys, "train", *options, "--out", str(out))
    picture = tmp_path / "run-reachability.png"
    assert ("target_elevation_deg is 89" if is_target else "reaches no elevation at every azimuth") in message
    assert f"{picture} shows" in message
    assert picture.read_bytes().startswith(b"\x89PNG") and not any(out.iterdir())


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_out_of_range_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path, seed: int) -> None:
    out = tmp_path / "run"
    message = fails(capsys, "train", "--preset", "smoke", "--out", str(out), f"--seed={seed}")
    assert f"seed is {seed}; allowed: 0 to 4294967295" in message
    assert not any(out.iterdir())


def test_a_home_that_does_not_exist_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = str(tmp_path / "run")
    assert "does not exist" in fails(
        capsys, "train", "--preset", "smoke", "--out", out, "--object", "~nobody0/part.stl"
    )


def test_the_last_preset_counts(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main.parse(["train", "--preset", "cpu", "--preset=smoke", "--out", "x"]).config == Config.preset("smoke")
    out = str(tmp_path / "run")
    assert "unknown preset 'big'" in fails(capsys, "train", "--preset", "smoke", "--preset", "big", "--out", out)


@pytest.mark.parametrize("seed", ["x", -1, 2**32, None])
def test_a_damaged_seed_is_found_before_anything_runs(
    quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path, seed: Any
) -> None:
    loop.start_run(tmp_path, Config.preset("smoke"), seed=0)
    values = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(values | {"seed": seed}))
    before = contents(tmp_path)
    assert "config.json: seed is" in fails(capsys, "train", "--out", str(tmp_path), "--resume")
    assert contents(tmp_path) == before


@pytest.mark.parametrize("command", ["eval {run}", "video {run} --out {run}.mp4"])
def test_an_unfinished_run_is_not_evaluated(
    quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str
) -> None:
    config = Config.preset("smoke")
    loop.start_run(tmp_path / "run", config, seed=0)
    message = fails(capsys, *command.format(run=tmp_path / "run").split())
    assert f"0 of {config.num_iterations} iterations" in message and "--resume" in message
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_film_is_made_in_a_new_file_only(quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run = str(tmp_path / "run")
    main.main(["train", "--preset", "smoke", "--out", run])
    (tmp_path / "old.mp4").write_text("mine")
    before = contents(tmp_path)
    for out, message in {"old.mp4": "old.mp4 exists; name another file", "a.gif": "a.gif does not end in .mp4"}.items():
        assert message in fails(capsys, "video", run, "--out", str(tmp_path / out))
    assert contents(tmp_path) == before


def test_a_film_is_of_the_run_and_as_asked(quick: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    run, asked = tmp_path / "run", []
    main.main(["train", "--preset", "smoke", "--out", str(run)])
    monkeypatch.setattr(video, "make_video", lambda *arguments: asked.append(arguments) or "made")
    out = tmp_path / "films" / "a.mp4"
    main.main(["video", str(run), "--out", str(out)])
    main.main(["video", str(run), "--out", str(out), "--motion", "kinematic", "--seed", "3"])
    assert [arguments[3:] for arguments in asked] == [("dynamic", None), ("kinematic", 3)]
    assert all(arguments[0] == out and arguments[2] == read_config(run) for arguments in asked)
    assert out.parent.is_dir() and not out.exists()


def test_damaged_config_is_one_line(quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    loop.start_run(tmp_path, Config.preset("smoke"), seed=0)
    whole = (tmp_path / "config.json").read_text()
    for text, message in {"": "not JSON", "[]": "no JSON object", whole.replace('"arm"', '"leg"'): "leg"}.items():
        (tmp_path / "config.json").write_text(text)
        assert message in fails(capsys, "eval", str(tmp_path))


@pytest.mark.parametrize(("file_limit", "is_started"), [(1_000, False), (2_500, False), (9_000, True)])
def test_full_disk_is_one_line_and_keeps_what_was_saved(tmp_path: Path, file_limit: int, is_started: bool) -> None:
    out = tmp_path / "run"
    # No file may grow past the limit: config.json, the first checkpoint or a figure is the first to be larger.
    code = f"import resource, runpy, sys; resource.setrlimit(resource.RLIMIT_FSIZE, ({file_limit}, {file_limit}));"
    code += f"sys.path.insert(0, {str(ROOT / 'tests')!r}); sys.argv[0] = {STANDIN!r};"
    code += f"runpy.run_path({STANDIN!r}, run_name='__main__')"
    command = program("-c", code, "train", "--preset", "smoke", "--out", str(out))
    done = subprocess.run(**command, capture_output=True, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("vsearch: error: cannot write") and str(out) in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert any(out.iterdir()) == is_started
    assert checkpoint.latest_step(out) == (24 if is_started else None)


def wait_for_step(out: Path, step: int, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 300
    while (checkpoint.latest_step(out) or 0) < step:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)


def wait_for_line(start: str, process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    while not (line := process.stdout.readline()).startswith(start):
        assert line, process.communicate()


def test_killed_and_resumed_equals_uninterrupted(quick: None, tmp_path: Path) -> None:
    arguments = ["train", "--preset", "smoke", "--seed", "3", "--out"]
    main.main([*arguments, str(tmp_path / "whole")])
    out = tmp_path / "killed"
    process = subprocess.Popen(**program(STANDIN, *arguments, str(out)), stdout=subprocess.DEVNULL)
    wait_for_step(out, 6, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (out / "results.json").exists()
    with (out / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 23, "sta')  # as a kill within a write leaves it
    main.main([*arguments, str(out), "--resume"])
    assert without_times(out) == without_times(tmp_path / "whole")
    whole, killed = stored_state(tmp_path / "whole"), stored_state(out)
    assert whole.keys() == killed.keys()
    for name in whole:
        np.testing.assert_array_equal(whole[name], killed[name], err_msg=name)
    assert (out / "results.json").exists()


def test_another_motion_is_evaluated_into_a_folder_of_its_own(
    quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run, out = tmp_path / "run", tmp_path / "dynamic"
    main.main(["train", "--preset", "smoke", "--out", str(run)])
    before = contents(run)
    assert "name a folder for the results" in fails(capsys, "eval", str(run), "--motion", "dynamic")
    main.main(["eval", str(run), "--motion", "dynamic", "--out", str(out)])
    assert contents(run) == before
    results = json.loads((out / "results.json").read_text())
    assert (results["motion"], results["reachable"]) == ("dynamic", "path")
    assert "dynamic motion" in (out / "report.html").read_text()
    assert "exists; name another folder" in fails(capsys, "eval", str(run), "--motion", "dynamic", "--out", str(out))
    assert "EnvConfig.motion" in fails(capsys, "eval", str(run), "--motion", "dynamic", "--reachable", "ik")


@pytest.mark.slow
def test_the_real_run_killed_and_resumed_equals_uninterrupted(tmp_path: Path) -> None:
    start = "from vsearch_jax.cli.main import main; main()"
    arguments = ["-c", start, "train", "--preset", "smoke", "--seed", "3", "--sac.num-seeds", "2", "--out"]
    subprocess.run(**program(*arguments, str(tmp_path / "whole")), check=True, stdout=subprocess.DEVNULL)
    out = tmp_path / "killed"
    for step in (6, 12):
        last = ["--resume"] if step > 6 else []
        process = subprocess.Popen(**program(*arguments, str(out), *last), stdout=subprocess.DEVNULL)
        wait_for_step(out, step, process)
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run(**program(*arguments, str(out), "--resume"), check=True, stdout=subprocess.DEVNULL)
    assert without_times(out) == without_times(tmp_path / "whole")
    whole, killed = stored_state(tmp_path / "whole"), stored_state(out)
    assert whole.keys() == killed.keys()
    for name in whole:
        np.testing.assert_array_equal(whole[name], killed[name], err_msg=name)
    results = [json.loads((tmp_path / run / "results.json").read_text()) for run in ("whole", "killed")]
    assert all(results[0][name] == results[1][name] for name in ("random_search", "cma_es", "sac", "seed"))


@pytest.mark.parametrize("signal_", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_says_how_to_go_on(quick: None, tmp_path: Path, signal_: signal.Signals) -> None:
    out = tmp_path / "run"
    command = ["train", "--preset", "smoke", "--out", str(out)]
    process = subprocess.Popen(**program(STANDIN, *command), stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=1)
    wait_for_line("6/24", process)
    time.sleep(0.2)  # into the second chunk
    process.send_signal(signal_)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "stopping after this chunk" in output
    step = checkpoint.latest_step(out)
    assert step >= 12, "the chunk that was running when the signal came is saved"
    assert not (out / "results.json").exists()
    line = f"vsearch: interrupted; {step} iterations are saved. Go on with: vsearch train --out {out} --resume"
    assert errors.strip() == line
    main.main([*command, "--resume"])
    assert checkpoint.latest_step(out) == Config.preset("smoke").num_iterations


def test_a_second_interrupt_leaves_the_chunk(tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = program(STANDIN, "train", "--preset", "smoke", "--out", str(out))
    process = subprocess.Popen(**command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=1)
    for line in ("6/24", "stopping after this chunk"):
        wait_for_line(line, process)
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "6 iterations are saved" in errors and checkpoint.latest_step(out) == 6


def test_a_folder_in_use_is_refused(quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    command = ["train", "--preset", "smoke", "--out", str(out)]
    with lock_folder(out):
        assert "another process is at work in" in fails(capsys, *command)
        assert not any(out.iterdir())
        with pytest.raises(RunError, match="another process"), lock_folder(out):
            pass
    main.main(command)  # the hold ends with its block
    with lock_folder(out):
        assert "another process is at work in" in fails(capsys, *command, "--resume")
        assert "another process is at work in" in fails(capsys, "eval", str(out))


def test_the_seed_is_kept(quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    main.main(["train", "--preset", "smoke", "--out", str(out), "--seed", "7"])
    assert read_seed(out) == 7
    assert json.loads((out / "results.json").read_text())["seed"] == 7
    assert "has seed 7" in fails(capsys, "train", "--out", str(out), "--resume", "--seed", "8")
    main.main(["train", "--out", str(out), "--resume", "--evaluation.num-runs", "2"])
    assert (read_seed(out), read_config(out).evaluation.num_runs) == (7, 2)


def test_a_damaged_line_of_metrics_is_named(quick: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    main.main(["train", "--preset", "smoke", "--out", str(out)])
    lines = (out / "metrics.jsonl").read_text().splitlines()
    for damage in ("\0\0", "\udcff", "3", '{"iteration": 3}'):
        text = "\n".join([*lines[:3], damage, *lines[4:]]) + "\n"
        (out / "metrics.jsonl").write_bytes(text.encode(errors="surrogateescape"))
        assert "metrics.jsonl: line 4 is damaged" in fails(capsys, "eval", str(out))


@pytest.mark.parametrize(("name", "row"), [("encoder_loss", 2), ("reward", 9), ("actor_loss", 20), ("critic_loss", 20)])
def test_a_diverged_run_is_stopped(tmp_path: Path, name: str, row: int) -> None:
    config = Config.preset("smoke")  # 8 encoder updates, 4 policy iterations of warm-up, 12 with updates
    number = np.arange(config.num_iterations)
    first = {"encoder_loss": 0, "reward": 8, "actor_loss": 12, "critic_loss": 12}
    columns = {key: np.where(number >= start, 1.0, np.nan) for key, start in first.items()}
    columns["stage"] = (number >= 8).astype(np.int32)
    loop.check_finite(tmp_path, columns, 0, config)
    columns[name][row] = np.nan
    with pytest.raises(RunError, match=f"{name} is not finite .*learning-rate"):
        loop.check_finite(tmp_path, columns, 0, config)


def test_log_drops_what_lies_past_the_step_it_goes_on_from(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path, 0)
    columns = {"stage": np.zeros(6, np.int32), "encoder_loss": np.arange(6.0), "reward": np.full(6, np.nan)}
    log.append(columns, 0, 3.0)
    log.close()
    log = MetricsLog(tmp_path, 4)
    log.append({name: column[4:5] for name, column in columns.items()}, 4, 1.0)
    log.close()
    lines = read_metrics(tmp_path)
    assert [line["iteration"] for line in lines] == [0, 1, 2, 3, 4]
    assert lines[3] == {"iteration": 3, "stage": "encoder", "seconds": 0.5, "encoder_loss": 3.0}
    assert any((tmp_path / "tensorboard").iterdir())
