import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import user_error

from vsearch_jax.cli.commands import COMMANDS, Export, Train, Video
from vsearch_jax.cli.main import main
from vsearch_jax.cli.parse import parse
from vsearch_jax.config import Config
from vsearch_jax.runs.folder import write_config


def parse_train(*arguments: str) -> Train:
    command = parse(["train", *arguments])
    assert isinstance(command, Train)
    return command


SLOW_MODULES = ("jax", "mujoco", "orbax", "matplotlib", "rich")


def run_help(arguments: list[str], slow: tuple[str, ...]) -> list[str]:
    """Runs `vsearch ARGUMENTS` in a new process. The last line says which of the modules `slow` it loaded."""
    code = f"import sys; sys.argv = ['vsearch', *{arguments!r}]\nfrom vsearch_jax.cli.main import main\n"
    code += f"try: main()\nexcept SystemExit as e: print([m for m in {slow!r} if m in sys.modules], e.code)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_help_names_every_command_and_loads_no_slow_module() -> None:
    *lines, last = run_help(["--help"], (*SLOW_MODULES, "typeguard"))
    assert last == "[] 0"
    for name in COMMANDS:
        assert any(re.search(rf"\b{name}\b", line) for line in lines), name


def test_help_of_train_names_its_options_and_loads_no_slow_module() -> None:
    *lines, last = run_help(["train", "--help"], SLOW_MODULES)
    assert last == "[] 0"
    for option in ("--preset", "--object", "--arm", "--input", "--resume", "--sac.num-seeds", "--encoder.num-updates"):
        assert option in "\n".join(lines)


def test_options_change_the_preset() -> None:
    options = "--preset smoke --out x --object truck --input depth --sac.num-seeds 4 --encoder.channels 4 8"
    config = parse_train(*options.split()).config
    assert (config.scene.object, config.encoder.input, config.sac.num_seeds) == ("truck", "depth", 4)
    assert config.encoder.channels == (4, 8)
    assert config.sac.num_envs == Config.preset("smoke").sac.num_envs


def test_paths_are_made_absolute(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    scene = parse_train("--out", "x", "--object", "part.stl", "--scene.arm", "arms/own.xml").config.scene
    assert scene.object == str(tmp_path / "part.stl")
    assert scene.arm == str(tmp_path / "arms" / "own.xml")


def test_the_home_folder_is_expanded_in_every_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert parse_train("--out=~/x").out == tmp_path / "x"
    assert parse(["video", "~/run", "--out=~/a.mp4"]) == Video(tmp_path / "run", tmp_path / "a.mp4")
    (tmp_path / "run").mkdir()
    write_config(tmp_path / "run", Config.preset("thesis"), 0, {})
    assert parse_train("--out=~/run", "--resume").config == Config.preset("thesis")


def test_policy_and_episode_are_numbers() -> None:
    assert parse(["export", "run", "--out", "x", "--policy", "2"]) == Export(Path("run"), Path("x"), policy=2)
    assert parse(["video", "run", "--out", "x.mp4", "--episode", "3"]) == Video(Path("run"), Path("x.mp4"), episode=3)


@pytest.mark.parametrize("command", ["export run --out x --seed 1", "video run --out x.mp4 --seed 1"])
def test_only_train_has_a_seed(capsys: pytest.CaptureFixture[str], command: str) -> None:
    assert "--seed" in user_error(capsys, *command.split())


def test_the_last_preset_counts(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert parse_train("--preset", "cpu", "--preset=smoke", "--out", "x").config == Config.preset("smoke")
    out = str(tmp_path / "run")
    assert "--preset is 'big'" in user_error(capsys, "train", "--preset", "smoke", "--preset", "big", "--out", out)


def test_an_empty_value_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = str(tmp_path / "run")
    assert "the value of --object is empty" in user_error(capsys, "train", "--object", "", "--out", out)


def test_a_folder_below_a_file_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    error = user_error(capsys, "reach", "--out", str(tmp_path / "file" / "run"))
    assert re.search(r"--out is .*, but the folder .* cannot be made \(Not a directory\); name another folder", error)


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(["--version"])
    assert not exit_.value.code
    assert capsys.readouterr().out.strip() == f"vsearch_jax {importlib.metadata.version('vsearch_jax')}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "train, eval, export, reach, video, info"),
        ("bogus", "unknown command 'bogus'; allowed: train, eval, export, reach, video, info"),
        ("train", "--out"),
        ("train --out {out} --preset huge", "--preset is 'huge'; allowed: smoke, cpu, autoencoder, thesis, gpu"),
        ("train --out {out} --encoder.num-updates 0", "--encoder.num-updates is 0; allowed: greater than 0"),
        ("train --out {out} --encoder.num-updates many", "--encoder.num-updates: invalid literal for int.* 'many'"),
        ("train --out {out} --input infrared", "infrared"),
        ("train --out {out} --bogus 1", "--bogus"),
        ("train --out {out} --resume", "no run in"),
        ("eval {out}", "no run in .*config.json is missing"),
        ("eval {out} --motion flying", "flying"),
        ("export {out} --out {out}2", "no run in"),
        ("video {out} --out {out}.mp4", "no run in"),
        ("reach --out {out} --radius -1", "--radius is -1"),
        ("reach --out {out} --mesh-scale 0", "--mesh-scale is 0"),
        ("reach --out {out} --mesh-up up", "--mesh-up.*auto.*-z"),
        ("train --out {out} --scene.mesh-up w", "--scene.mesh-up.*auto.*-z"),
        ("info --bogus", "--bogus"),
        ("train --out {out} --preset=", "the value of --preset is empty"),
        ("train --out= --preset smoke", "the value of --out is empty"),
    ],
)
def test_an_error_of_the_user_is_one_line_and_makes_no_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments: str, message: str
) -> None:
    assert re.search(message, user_error(capsys, *arguments.format(out=tmp_path / "run").split()))
    assert not any(tmp_path.iterdir())
