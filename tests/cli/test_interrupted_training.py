import json
import signal
import subprocess
import time
from pathlib import Path

import pytest
from command_line import FAST_RUN, assert_equal_runs, python, wait_for_line, wait_for_step

from vsearch_jax.cli.main import main
from vsearch_jax.config import Config
from vsearch_jax.runs import checkpoint


def test_a_killed_and_resumed_run_equals_an_uninterrupted_one(fast: None, tmp_path: Path) -> None:
    arguments = ["train", "--preset", "smoke", "--seed", "3", "--out"]
    main([*arguments, str(tmp_path / "whole")])
    out = tmp_path / "killed"
    process = subprocess.Popen(**python(*FAST_RUN, *arguments, str(out)), stdout=subprocess.DEVNULL)
    wait_for_step(out, 6, process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (out / "results.json").exists()
    with (out / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 23, "sta')  # A kill during a write leaves such a line.
    main([*arguments, str(out), "--resume"])
    assert_equal_runs(out, tmp_path / "whole")
    assert (out / "results.json").exists()


@pytest.mark.slow
def test_the_real_run_killed_and_resumed_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    start = "from vsearch_jax.cli.main import main; main()"
    arguments = ["-c", start, "train", "--preset", "smoke", "--seed", "3", "--sac.num-seeds", "2", "--out"]
    subprocess.run(**python(*arguments, str(tmp_path / "whole")), check=True, stdout=subprocess.DEVNULL)
    out = tmp_path / "killed"
    for step in (6, 12):
        resume = ["--resume"] if step > 6 else []
        process = subprocess.Popen(**python(*arguments, str(out), *resume), stdout=subprocess.DEVNULL)
        wait_for_step(out, step, process)
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run(**python(*arguments, str(out), "--resume"), check=True, stdout=subprocess.DEVNULL)
    assert_equal_runs(out, tmp_path / "whole")
    results = [json.loads((tmp_path / run / "results.json").read_text()) for run in ("whole", "killed")]
    assert all(results[0][name] == results[1][name] for name in ("random_search", "cma_es", "sac", "seed"))


@pytest.mark.parametrize("signal_", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_saves_the_chunk_and_says_how_to_resume(
    fast: None, tmp_path: Path, signal_: signal.Signals
) -> None:
    out = tmp_path / "run"
    command = ["train", "--preset", "smoke", "--out", str(out)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "bufsize": 1}
    process = subprocess.Popen(**python(*FAST_RUN, *command), **pipes)
    wait_for_line("6/24", process)
    time.sleep(0.2)  # The second chunk has started.
    process.send_signal(signal_)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "stopping after this chunk" in output
    step = checkpoint.latest_step(out)
    assert step is not None and step >= 12, "the chunk that ran when the signal came is saved"
    assert not (out / "results.json").exists()
    line = f"vsearch: interrupted; {step} iterations are saved. Resume with: vsearch train --out {out} --resume"
    assert errors.strip() == line
    main([*command, "--resume"])
    assert checkpoint.latest_step(out) == Config.preset("smoke").num_iterations


def test_a_second_interrupt_does_not_save_the_chunk(tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = python(*FAST_RUN, "train", "--preset", "smoke", "--out", str(out))
    process = subprocess.Popen(**command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=1)
    for line in ("6/24", "stopping after this chunk"):
        wait_for_line(line, process)
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "6 iterations are saved" in errors and checkpoint.latest_step(out) == 6
