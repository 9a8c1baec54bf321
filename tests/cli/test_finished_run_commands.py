import json
from pathlib import Path

import pytest
from command_line import contents, user_error

from vsearch_jax import film
from vsearch_jax.cli.main import main
from vsearch_jax.config import Config
from vsearch_jax.export import stablehlo
from vsearch_jax.runs import loop
from vsearch_jax.runs.folder import read_config


@pytest.mark.parametrize("command", ["eval {run}", "export {run} --out {run}2", "video {run} --out {run}.mp4"])
def test_an_unfinished_run_is_refused(
    fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str
) -> None:
    config = Config.preset("smoke")
    loop.start_run(tmp_path / "run", config, seed=0)
    message = user_error(capsys, *command.format(run=tmp_path / "run").split())
    assert f"0 of {config.num_iterations} iterations" in message and "--resume" in message
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_film_needs_a_new_file(fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run = str(tmp_path / "run")
    main(["train", "--preset", "smoke", "--out", run])
    (tmp_path / "old.mp4").write_text("mine")
    before = contents(tmp_path)
    remedies = {"old.mp4": "which exists; name another file", "a.gif": "name a file that ends in .mp4"}
    for name, remedy in remedies.items():
        message = user_error(capsys, "video", run, "--out", str(tmp_path / name))
        assert f"--out is {tmp_path / name}" in message and remedy in message
    assert contents(tmp_path) == before


def test_video_passes_the_run_and_its_options(fast: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    run, calls = tmp_path / "run", []
    main(["train", "--preset", "smoke", "--out", str(run)])
    monkeypatch.setattr(film, "make_film", lambda *arguments: calls.append(arguments) or "made", raising=False)
    out = tmp_path / "films" / "a.mp4"
    main(["video", str(run), "--out", str(out)])
    main(["video", str(run), "--out", str(out), "--motion", "kinematic", "--episode", "3"])
    assert [arguments[3:] for arguments in calls] == [("dynamic", None), ("kinematic", 3)]
    assert all(arguments[0] == out and arguments[2] == read_config(run) for arguments in calls)
    assert out.parent.is_dir() and not out.exists()


def test_export_passes_the_run_and_its_policy(fast: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    run, out, calls = tmp_path / "run", tmp_path / "files", []
    main(["train", "--preset", "smoke", "--out", str(run)])
    monkeypatch.setattr(stablehlo, "export", lambda *arguments: calls.append(arguments))
    main(["export", str(run), "--out", str(out), "--policy", "2"])
    ((folder, state, config, policy),) = calls
    assert (folder, int(state.step), policy) == (out, config.num_iterations, 2)
    assert config == read_config(run)


def test_another_motion_needs_its_own_folder(fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    run, out = tmp_path / "run", tmp_path / "dynamic"
    main(["train", "--preset", "smoke", "--out", str(run)])
    before = contents(run)
    message = user_error(capsys, "eval", str(run), "--motion", "dynamic")
    assert "--reachable ik and --motion kinematic; name a folder for the results" in message
    main(["eval", str(run), "--motion", "dynamic", "--out", str(out)])
    assert contents(run) == before
    results = json.loads((out / "results.json").read_text())
    assert (results["motion"], results["reachable"]) == ("dynamic", "path")
    assert "dynamic motion" in (out / "report.html").read_text()
    again = ["eval", str(run), "--motion", "dynamic", "--out", str(out)]
    assert "exists; name another folder" in user_error(capsys, *again)
    message = user_error(capsys, "eval", str(run), "--motion", "dynamic", "--reachable", "ik")
    assert "--motion is 'dynamic'" in message and "--reachable" in message and "EnvConfig" not in message


def test_a_damaged_config_is_one_line(fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    loop.start_run(tmp_path, Config.preset("smoke"), seed=0)
    whole = (tmp_path / "config.json").read_text()
    for text, message in {"": "not JSON", "[]": "no JSON object", whole.replace('"arm"', '"leg"'): "leg"}.items():
        (tmp_path / "config.json").write_text(text)
        assert message in user_error(capsys, "eval", str(tmp_path))


def test_a_damaged_line_of_metrics_is_named(fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "run"
    main(["train", "--preset", "smoke", "--out", str(out)])
    lines = (out / "metrics.jsonl").read_text().splitlines()
    for damage in ("\0\0", "\udcff", "3", '{"iteration": 3}'):
        text = "\n".join([*lines[:3], damage, *lines[4:]]) + "\n"
        (out / "metrics.jsonl").write_bytes(text.encode(errors="surrogateescape"))
        message = user_error(capsys, "eval", str(out))
        assert "metrics.jsonl: line 4 is damaged; restore the file from a copy" in message
        assert "delete" not in message
