import dataclasses
import json
from pathlib import Path

import pytest
from command_line import user_error

from vsearch_jax.cli.commands import Command, Eval, Export, Reach, Train, Video
from vsearch_jax.cli.option_names import use_option_names
from vsearch_jax.cli.parse import parse
from vsearch_jax.config import Config
from vsearch_jax.runs import loop


@pytest.mark.parametrize(
    ("command_type", "message", "expected"),
    [
        (Train, "SceneConfig.mount_height is -1; allowed", "--scene.mount-height is -1; allowed"),
        (Train, "Config.num_chunks is 0", "--num-chunks is 0"),
        (Train, "CMAESConfig.sigma_deg is 0", "--cma-es.sigma-deg is 0"),
        (Train, "sac.discount is 0.9 in the checkpoint", "--sac.discount is 0.9 in the checkpoint"),
        (Train, "it proposes a mount_height", "it proposes a --scene.mount-height"),
        (Train, "propose another mount_height.", "propose another --scene.mount-height."),
        # Three classes have a batch_size. The message names one of them.
        (
            Train,
            "SACConfig.num_envs: a multiple of batch_size (8)",
            "--sac.num-envs: a multiple of --sac.batch-size (8)",
        ),
        (Train, "a multiple of batch_size (8)", "a multiple of batch_size (8)"),
        # Ordinary words, sections, quoted names and paths stay.
        (Train, "the radius and the motion of random_search", "the radius and the motion of random_search"),
        (Train, "file 'mount_height' in /runs/mount_height/a", "file 'mount_height' in /runs/mount_height/a"),
        (Train, "SceneConfig.no_such_field", "SceneConfig.no_such_field"),
        (Eval, "EnvConfig.motion is 'x'; needs env.reachable 'path'", "--motion is 'x'; needs --reachable 'path'"),
        (Eval, "EvaluationConfig.target_elevation_deg is 89", "EvaluationConfig.target_elevation_deg is 89"),
        (Reach, "SceneConfig.center_height is -1", "--center-height is -1"),
        (Reach, "SceneConfig.mount_height is -1", "SceneConfig.mount_height is -1"),
        (Export, "SceneConfig.radius is -1", "SceneConfig.radius is -1"),
        # The short option, if there is one.
        (Train, "SceneConfig.object is 'cup'; available: truck", "--object is 'cup'; available: truck"),
        (Train, "EncoderConfig.input is 'x'", "--input is 'x'"),
        (Reach, "SceneConfig.arm is 'kuka'", "--arm is 'kuka'"),
        (Video, "add it to the arm's file, or set EnvConfig.motion", "add it to the arm's file, or set --motion"),
        # Arguments of Python functions.
        (Train, "`seed` is -1", "--seed is -1"),
        (Export, "`seed` is -1", "`seed` is -1"),
        (Export, "`policy` is 7", "--policy is 7"),
        (Video, "`path` is /a/policy.gif; film it with `episode`", "--out is /a/policy.gif; film it with --episode"),
        (Reach, "`folder` is /runs/seed, which exists", "--out is /runs/seed, which exists"),
        (Train, "the site `tcp` and run `vsearch reach`", "the site `tcp` and run `vsearch reach`"),
    ],
)
def test_fields_with_an_option_are_replaced(command_type: type[Command], message: str, expected: str) -> None:
    assert use_option_names(message, command_type) == expected


def test_every_field_becomes_an_option_that_train_has() -> None:
    for section in dataclasses.fields(Config):
        value = getattr(Config(), section.name)
        fields = dataclasses.fields(value) if dataclasses.is_dataclass(value) else []
        for field in fields:
            option = use_option_names(f"{type(value).__name__}.{field.name}", Train)
            is_short = field.name in ("arm", "object", "input")
            expected = f"{'' if is_short else section.name + '.'}{field.name}"
            assert option == f"--{expected.replace('_', '-')}"
    value = parse(["train", "--out", "x", use_option_names("CMAESConfig.sigma_deg", Train), "45"])
    assert isinstance(value, Train) and value.config.cma_es.sigma_deg == 45.0


def test_a_damaged_file_is_reported_with_the_names_in_the_file(
    fast: None, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    loop.start_run(tmp_path, Config.preset("smoke"), seed=0)
    values = json.loads((tmp_path / "config.json").read_text())
    values["env"]["motion"] = "flying"
    (tmp_path / "config.json").write_text(json.dumps(values))
    assert "config.json: EnvConfig.motion is 'flying'" in user_error(capsys, "eval", str(tmp_path))
    assert "config.json: EnvConfig.motion is 'flying'" in user_error(
        capsys, "train", "--out", str(tmp_path), "--resume"
    )
