"""Standard output that shows no letters beyond ASCII, that is full, or that nobody reads."""

import errno
import io
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from command_line import python, user_error

from vsearch_jax.cli.main import main
from vsearch_jax.config import Config
from vsearch_jax.runs import checkpoint

NUM_ITERATIONS = Config.preset("smoke").num_iterations


class Failing(io.StringIO):
    """A stream whose writes fail once it holds a text."""

    def __init__(self, text: str, number: int) -> None:
        super().__init__()
        self.text, self.number = text, number

    def write(self, text: str) -> int:
        if self.text in self.getvalue():
            raise OSError(self.number, os.strerror(self.number))
        return super().write(text)


def test_a_file_without_unicode_gets_other_characters_and_a_line_before_each_long_computation(
    fast: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    written, out = io.BytesIO(), tmp_path / "é[red]:cat:#1"  # Brackets and colons would be rich's markup.
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii", errors="strict"))
    main(["train", "--preset", "smoke", "--out", str(out)])
    text = written.getvalue().decode("ascii")
    assert f"{NUM_ITERATIONS}/{NUM_ITERATIONS} policy" in text and "SAC policy alone" in text
    assert (out / "results.json").exists() and f"report: {tmp_path}/?[red]:cat:#1/report.html" in text
    lines = text.splitlines()
    assert lines[:2] == ["building the scene, computing what the arm reaches", "compiling the training"]
    assert lines.index("evaluating every searcher") > 2


def test_a_reader_that_ends_ends_the_command_silently_and_the_run_can_be_resumed(
    fast: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "run"
    with monkeypatch.context() as context:
        context.setattr(sys, "stdout", Failing("6/24", errno.EPIPE))
        with pytest.raises(SystemExit) as exit_:
            main(["train", "--preset", "smoke", "--out", str(out)])
    assert exit_.value.code == 141 and capsys.readouterr().err == ""
    assert checkpoint.latest_step(out) == 12  # The line after 12 iterations could not be written.
    main(["train", "--out", str(out), "--resume"])
    assert checkpoint.latest_step(out) == NUM_ITERATIONS and (out / "results.json").exists()


def test_a_full_standard_output_is_blamed_and_not_the_run(
    fast: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "run"
    for text, end in (
        ("6/24", f"; 12 iterations are saved. Resume with: vsearch train --out {out} --resume"),
        ("", ""),
    ):
        with monkeypatch.context() as context:
            context.setattr(sys, "stdout", Failing(text, errno.ENOSPC))
            name = out if text else tmp_path / "other"
            message = user_error(capsys, "train", "--preset", "smoke", "--out", str(name))
        assert message == f"vsearch: error: cannot write to standard output: No space left on device{end}\n"
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(("target", "status"), [("closed pipe", 141), ("/dev/full", 2)])
def test_the_end_of_the_process_is_silent_too(target: str, status: int) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    stdout = writing if target == "closed pipe" else os.open(target, os.O_WRONLY)
    command = python("-c", "from vsearch_jax.cli.main import main; main()", "--version")
    done = subprocess.run(**command, stdout=stdout, stderr=subprocess.PIPE, check=False)
    for descriptor in {writing, stdout}:
        os.close(descriptor)
    assert done.returncode == status
    wanted = "vsearch: error: cannot write to standard output: No space left on device\n"
    assert done.stderr == ("" if status == 141 else wanted)


def test_a_closed_standard_output_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    with pytest.raises(SystemExit) as exit_:
        main(["--version"])
    assert not exit_.value.code


def test_a_missing_device_or_a_refused_setting_is_one_line_and_makes_no_folder(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def fail() -> None:
        raise RuntimeError("Unable to initialize backend 'cuda':\n no GPU")

    command = ["train", "--preset", "smoke", "--out", str(tmp_path / "run")]
    with monkeypatch.context() as context:
        context.setattr(jax, "devices", fail)
        message = user_error(capsys, *command)
        assert "finds no device: Unable to initialize backend 'cuda': no GPU; set JAX_PLATFORMS=cpu" in message
    for name in ("jax_enable_x64", "jax_debug_nans"):
        jax.config.update(name, True)
        try:
            assert f"switch it off: {name.upper()}=0" in user_error(capsys, *command)
        finally:
            jax.config.update(name, False)
    assert not any(tmp_path.iterdir())
