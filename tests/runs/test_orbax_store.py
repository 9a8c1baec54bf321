"""Names of folders, and faults of reading and saving that are no damage."""

import errno
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest
from test_checkpoint import CONFIG, assert_same, make_run

from vsearch_jax.runs import checkpoint
from vsearch_jax.runs.checkpoint import CheckpointError
from vsearch_jax.runs.folder import RunError, make_new_folder, new_file, new_folder, resume_command

NAMES = ("run#2", "50%", "a?b", "a[b]", "a\\b", "a|b", "gs:", "%41", "~x", "$HOME", "é 日本", "dot.", "x" * 200)


@pytest.mark.parametrize("name", NAMES)
def test_a_run_folder_may_have_any_name(tmp_path: Path, name: str) -> None:
    run = tmp_path / name
    make_new_folder(run)
    state = make_run(jax.random.key(0), 3)
    checkpoint.save(run, state, CONFIG)
    template: Any = jax.eval_shape(lambda: state)
    assert_same(checkpoint.restore(run, template, CONFIG), state)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert os.listdir(run) == ["checkpoints"] and os.listdir(run / "checkpoints") == ["3"]


@pytest.mark.parametrize("name", ["a\nb", "a\x01b", "caf\udce9", "a\u2028b"])
def test_a_name_that_cannot_be_printed_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    for make in (
        lambda: make_new_folder(tmp_path / name),
        lambda: new_file(tmp_path / name / "a.mp4", ".mp4").__enter__(),
    ):
        with pytest.raises(RunError, match="name another path") as error:
            make()
        assert len(str(error.value).splitlines()) == 1 and str(error.value).isascii()
    assert not any(tmp_path.iterdir())


def test_a_name_that_is_too_long_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="File name too long"):
        make_new_folder(tmp_path / ("x" * 300))


def test_the_command_to_resume_names_the_folder_and_no_option() -> None:
    assert resume_command(Path("-x")) == "vsearch train --out ./-x --resume"
    assert resume_command(Path("a b#")) == "vsearch train --out 'a b#' --resume"


def test_after_an_error_only_empty_folders_that_were_made_are_removed(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    for folder, is_written in (("old/a/b", False), ("old", False), ("new/c", True)):
        with pytest.raises(KeyError), new_folder(tmp_path / folder):
            if is_written:
                (tmp_path / folder / "file").touch()
            raise KeyError
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == [
        "new",
        "new/c",
        "new/c/file",
        "old",
    ]


@pytest.mark.parametrize("error", [TypeError("unexpected keyword 'x'"), ValueError("tree differs"), KeyError("state")])
def test_a_fault_of_orbax_is_not_called_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    state = make_run(jax.random.key(0), 3)
    checkpoint.save(tmp_path, state, CONFIG)
    template: Any = jax.eval_shape(lambda: state)
    with monkeypatch.context() as context:
        context.setattr(ocp.CheckpointManager, "restore", fail)
        with pytest.raises(CheckpointError) as raised:
            checkpoint.restore(tmp_path, template, CONFIG)
        message = str(raised.value)
        assert type(error).__name__ in message and str(error) in message and "its files are whole" in message
        assert "damaged" not in message and f"that wrote it ({ocp.__version__})" in message
        context.setattr(ocp.CheckpointManager, "save", fail)
        with pytest.raises(CheckpointError, match=f"cannot write a checkpoint .*{type(error).__name__}"):
            checkpoint.save(tmp_path, make_run(jax.random.key(0), 4), CONFIG)
    assert_same(checkpoint.restore(tmp_path, template, CONFIG), state)


def test_an_error_of_the_system_is_not_called_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = make_run(jax.random.key(0), 3)
    checkpoint.save(tmp_path, state, CONFIG)
    template: Any = jax.eval_shape(lambda: state)
    for number in (errno.EIO, errno.EMFILE):

        def fail(*_: object, number: int = number, **__: object) -> None:
            raise ValueError(f"Error reading local file [OS error {number}: some text]")

        with monkeypatch.context() as context:
            context.setattr("tensorstore.KvStore.open", fail)
            with pytest.raises(OSError, match=os.strerror(number)) as raised:
                checkpoint.restore(tmp_path, template, CONFIG)
        assert raised.value.filename == str(tmp_path / "checkpoints" / "3")


@pytest.mark.parametrize("name", ["manifest.ocdbt", "d", ""])
def test_a_missing_file_of_a_checkpoint_is_damage(tmp_path: Path, name: str) -> None:
    state = make_run(jax.random.key(0), 3)
    checkpoint.save(tmp_path, state, CONFIG)
    template: Any = jax.eval_shape(lambda: state)
    (tmp_path / "checkpoints" / "3" / "state" / name).rename(tmp_path / "aside")
    with pytest.raises(CheckpointError, match="is damaged"):
        checkpoint.restore(tmp_path, template, CONFIG)


def test_an_array_of_another_shape_in_the_same_version_blames_the_files_of_the_scene(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, make_run(jax.random.key(0)), CONFIG)
    with pytest.raises(CheckpointError, match="restore the files of arm and object"):
        checkpoint.restore(tmp_path, {"step": np.zeros(3)}, CONFIG)
