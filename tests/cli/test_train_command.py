import dataclasses
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import TESTS, contents, python, user_error

from samples import fast_run, made_up
from vsearch_jax.cli.main import main
from vsearch_jax.config import Config
from vsearch_jax.runs import checkpoint, loop
from vsearch_jax.runs.folder import RunError, lock_folder, read_config, read_seed
from vsearch_jax.runs.metrics_log import STAGES, read_metrics
from vsearch_jax.scene import xml_folder


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--object nothing", "--object is 'nothing'; available: bracket"),
        ("--arm {out}/own.xml", "--arm is .*own.xml', a file that does not exist"),
    ],
)
def test_a_scene_that_cannot_be_built_leaves_no_folder(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, option: str, message: str
) -> None:
    out = tmp_path / "run"
    command = f"train --preset smoke --out {out} {option.format(out=tmp_path)}"
    assert re.search(message, user_error(capsys, *command.split()))
    assert not any(tmp_path.iterdir())


def test_the_home_of_an_unknown_user_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    command = ["train", "--preset", "smoke", "--out", str(tmp_path / "run"), "--object", "~nobody0/part.stl"]
    assert "does not exist" in user_error(capsys, *command)


def test_a_run_writes_every_file_of_its_folder(fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "deep" / "run"
    main(["train", "--preset", "smoke", "--out", str(out), "--sac.num-seeds", "2"])
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
    assert "SAC policy alone" in printed and f"{config.num_iterations}/{config.num_iterations} policy" in printed
    assert "false matches 0.25, angle at the threshold (°) 3.5" in printed
    assert re.search(r"policy, .* pose success 0\.\d+\n", printed)


def test_a_folder_with_files_is_not_used(fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    message = user_error(capsys, "train", "--preset", "smoke", "--out", str(out))
    assert f"--out is {out}, which exists; name another folder" in message
    assert contents(out) == {"notes.txt": b"mine"}


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--sac.discount", "0.5", "--sac.discount is 0.9 in the checkpoint and 0.5 now"),
        ("--evaluation.target-elevation-deg", "89", "--evaluation.target-elevation-deg is 89"),
    ],
)
def test_an_option_that_a_resumed_run_cannot_take_is_named_and_changes_nothing(
    fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path, option: str, value: str, expected: str
) -> None:
    out = str(tmp_path / "run")
    main(["train", "--preset", "smoke", "--out", out])
    before = contents(tmp_path)
    assert expected in user_error(capsys, "train", "--out", out, "--resume", option, value)
    assert contents(tmp_path) == before


def test_an_arm_that_was_edited_after_the_training_is_named_and_its_speeds_may_be_added(
    fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out, arm = tmp_path / "run", tmp_path / "arm.xml"
    arm.write_text((xml_folder() / "arm" / "ur5e.xml").read_text())
    config = Config.preset("smoke")
    loop.start_run(out, dataclasses.replace(config, scene=dataclasses.replace(config.scene, arm=str(arm))), seed=0)
    whole = arm.read_text()
    arm.write_text(re.sub(r' user="[^"]*"', "", whole))
    loop.resume_run(out, read_config(out))
    arm.write_text(re.sub(r' range="[^"]*"', ' range="-1 1"', whole))
    before = contents(out)
    for command in (["train", "--out", str(out), "--resume"], ["eval", str(out)], ["video", str(out), "--out=a.mp4"]):
        message = user_error(capsys, *command)
        assert f"arm file {str(arm)!r} has changed since this run was trained (changed: arm.xml)" in message
        assert "restore the files" in message and contents(out) == before


@pytest.mark.parametrize("is_target", [True, False])
def test_an_unreachable_target_or_band_is_drawn(
    fast: None,
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
    message = user_error(capsys, "train", *options, "--out", str(out))
    figure = tmp_path / "run-reachability.png"
    target, band = "--evaluation.target-elevation-deg is 89", "--scene.mount-height 1.355 reaches no elevation at every"
    assert (target if is_target else band) in message
    assert f"{figure} shows" in message
    assert figure.read_bytes().startswith(b"\x89PNG") and not out.exists()
    figure.write_text("mine")
    second = tmp_path / "run-reachability-2.png"
    assert f"{second} shows" in user_error(capsys, "train", *options, "--out", str(out))
    assert figure.read_text() == "mine" and second.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_out_of_range_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path, seed: int) -> None:
    out = tmp_path / "run"
    message = user_error(capsys, "train", "--preset", "smoke", "--out", str(out), f"--seed={seed}")
    assert f"--seed is {seed}; allowed: 0 to 4294967295" in message
    assert not out.exists()


@pytest.mark.parametrize("seed", ["x", -1, 2**32, None])
def test_a_damaged_seed_is_found_before_anything_is_written(
    fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path, seed: Any
) -> None:
    loop.start_run(tmp_path, Config.preset("smoke"), seed=0)
    values = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(values | {"seed": seed}))
    before = contents(tmp_path)
    assert "config.json: seed is" in user_error(capsys, "train", "--out", str(tmp_path), "--resume")
    assert contents(tmp_path) == before


def test_the_seed_of_a_run_stays(fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    main(["train", "--preset", "smoke", "--out", str(out), "--seed", "7"])
    assert read_seed(out) == 7
    assert json.loads((out / "results.json").read_text())["seed"] == 7
    assert "has seed 7" in user_error(capsys, "train", "--out", str(out), "--resume", "--seed", "8")
    main(["train", "--out", str(out), "--resume", "--evaluation.num-runs", "2"])
    assert (read_seed(out), read_config(out).evaluation.num_runs) == (7, 2)


def test_a_folder_in_use_is_refused(fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    command = ["train", "--preset", "smoke", "--out", str(out)]
    with lock_folder(out):
        assert "another process uses" in user_error(capsys, *command)
        assert not any(out.iterdir())
        with pytest.raises(RunError, match="another process"), lock_folder(out):
            pass
    main(command)  # the lock has ended with its block
    with lock_folder(out):
        assert "another process uses" in user_error(capsys, *command, "--resume")
        assert "another process uses" in user_error(capsys, "eval", str(out))


@pytest.mark.parametrize(("file_limit", "is_started"), [(1_000, False), (2_500, False), (12_000, True)])
def test_a_full_disk_is_one_line_and_keeps_what_was_saved(tmp_path: Path, file_limit: int, is_started: bool) -> None:
    out = tmp_path / "run"
    # No file may grow beyond the limit. The first larger file is config.json, the first checkpoint or a figure.
    code = f"import resource, runpy, sys; resource.setrlimit(resource.RLIMIT_FSIZE, ({file_limit}, {file_limit}));"
    code += "runpy.run_module('samples.fast_run', run_name='__main__')"
    command = python("-c", code, "train", "--preset", "smoke", "--out", str(out))
    done = subprocess.run(**command, cwd=TESTS, capture_output=True, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("vsearch: error: cannot write") and str(out) in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert out.exists() == is_started
    assert checkpoint.latest_step(out) == (24 if is_started else None)


def test_wrong_views_are_the_last_words(
    fast: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def evaluate(*_: Any) -> dict[str, Any]:
        results = made_up.evaluation()
        results["random_search"]["is_false_positive"] = results["random_search"]["is_success"]
        return results

    monkeypatch.setattr(loop, "evaluate", evaluate)
    main(["train", "--preset", "smoke", "--out", str(tmp_path / "run")])
    last = capsys.readouterr().out.splitlines()[-1]
    assert re.match(r"Wrong views were found: more than 10° .*Random search \d+\.\d %", last)
    assert "Train with --encoder.num-updates above 8." in last and "--scene.symmetry N" in last


def test_the_symmetry_of_the_object_is_said_and_noted(
    fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "run"
    main(["train", "--preset", "smoke", "--out", str(out), "--scene.symmetry", "4"])
    sentence = "The object counts as equal after each of 4 equal turns about the vertical"
    assert capsys.readouterr().out.count(sentence) == 2  # before the training, and below the table
    assert json.loads((out / "results.json").read_text())["symmetry"] == 4
    assert sentence in (out / "report.html").read_text()
