"""The scripts beside the package run whole, with a stand-in for the training and the evaluation."""

import functools
import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib.image
import mujoco
import numpy as np
import pytest
import trimesh

import vsearch_jax as vs
from samples import fast_run
from vsearch_jax import render, runs
from vsearch_jax.report import page
from vsearch_jax.runs import loop
from vsearch_jax.search import LABELS

ROOT = Path(__file__).resolve().parent.parent
CONFIG = vs.Config.preset("smoke")
SEED = 7
BALL = """<mujoco><worldbody>
  <light pos="0 0 3"/><camera name="room" pos="0 0 2"/><geom type="sphere" size="0.4" rgba="1 0.2 0.2 1"/>
</worldbody></mujoco>"""


def load(script: str) -> ModuleType:
    """Imports a script by its path in the checkout."""
    path = ROOT / script
    spec = importlib.util.spec_from_file_location(f"script_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def draw_small(draw: Callable[..., Any], *arguments: Any, size: tuple[int, int], factor: int) -> Any:
    """Renders an image of a tenth of the size, one ray for each pixel."""
    assert size == (480, 640) and factor == 3
    return draw(*arguments, size=(48, 64), factor=1)


def contents(folder: Path) -> dict[str, bytes]:
    """Returns the content of every file below a folder, by its relative path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def fast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces init, train, evaluate and the figures by those of the fast run, without its pauses."""
    for name in ("init", "train", "evaluate"):
        for module in (vs, loop):
            monkeypatch.setattr(module, name, getattr(fast_run, name))
    monkeypatch.setattr(page, "draw_figures", fast_run.draw_figures)
    monkeypatch.setattr(fast_run, "CHUNK_SECONDS", 0.0)


@pytest.fixture
def run(fast: None, tmp_path: Path) -> Path:
    """Makes a finished run, and returns its folder."""
    folder = tmp_path / "run"
    loop.train_to_end(folder, loop.start_run(folder, CONFIG, SEED), CONFIG)
    return folder


def test_train_writes_every_file_of_a_run(
    fast: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    script, folder = load("train/train.py"), tmp_path / "deep" / "run"
    monkeypatch.setattr(script, "record_search", fast_run.record_search)
    script.train(folder, CONFIG, SEED)
    names = {"checkpoints", "config.json", "figures", "metrics.jsonl", "report.html", "results.json"}
    assert names <= {path.name for path in folder.iterdir()}
    assert (runs.read_config(folder), runs.read_seed(folder)) == (CONFIG, SEED)
    assert runs.latest_step(folder) == CONFIG.num_iterations
    assert [line["iteration"] for line in runs.read_metrics(folder)] == list(range(CONFIG.num_iterations))
    results = json.loads((folder / "results.json").read_text())
    assert results["seed"] == SEED and results["wall_seconds"]["evaluation"] >= 0.0
    assert set(LABELS) <= set(results)
    printed = capsys.readouterr().out
    assert f"{CONFIG.num_iterations}/{CONFIG.num_iterations}" in printed and "sac: pose success" in printed
    with pytest.raises(runs.RunError, match="exists; name another folder"):
        script.train(folder, CONFIG, SEED)


def test_a_run_of_the_script_is_one_of_the_package(
    fast: None, monkeypatch: pytest.MonkeyPatch, run: Path, tmp_path: Path
) -> None:
    script, folder = load("train/train.py"), tmp_path / "by-script"
    monkeypatch.setattr(script, "record_search", fast_run.record_search)
    script.train(folder, CONFIG, SEED)
    states: list[Any] = [loop.resume_run(path, CONFIG) for path in (folder, run)]
    np.testing.assert_array_equal(states[0].weights, states[1].weights)
    for of_script, of_package in zip(runs.read_metrics(folder), runs.read_metrics(run), strict=True):
        assert of_script | {"seconds": 0.0} == of_package | {"seconds": 0.0}


def test_evaluate_writes_a_report_and_leaves_the_run_as_it_is(
    monkeypatch: pytest.MonkeyPatch, run: Path, tmp_path: Path
) -> None:
    script, out, before, configs = load("eval/evaluate.py"), tmp_path / "results", contents(run), []

    def evaluate(state: fast_run.State, config: vs.Config) -> dict[str, Any]:
        configs.append(config)
        return fast_run.evaluate(state, config)

    monkeypatch.setattr(vs, "evaluate", evaluate)
    monkeypatch.setattr(script, "record_search", fast_run.record_search)
    script.evaluate(run, out, 40, (120.0, 50.0), 20)
    settings = configs[0].evaluation
    assert (settings.num_episodes, settings.batch_size) == (40, 20)
    assert (settings.target_azimuth_deg, settings.target_elevation_deg) == (120.0, 50.0)
    assert {path.name for path in out.iterdir()} == {"figures", "report.html", "results.json"}
    assert json.loads((out / "results.json").read_text())["seed"] == SEED
    assert contents(run) == before
    with pytest.raises(runs.RunError, match="exists; name another folder"):
        script.evaluate(run, out, 40, (120.0, 50.0), 20)
    assert len(configs) == 1, "a folder that cannot be used is found before the evaluation"


def test_export_passes_the_run_and_the_policy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], run: Path, tmp_path: Path
) -> None:
    script, out, calls = load("eval/export.py"), tmp_path / "files", []

    def export(folder: Path, *rest: Any) -> None:
        calls.append(rest)
        (folder / "policy.stablehlo").write_text("made")

    monkeypatch.setattr(script, "export", export)
    script.export_run(run, out, 2)
    ((state, config, policy),) = calls
    assert (int(state.step), config, policy) == (CONFIG.num_iterations, CONFIG, 2)
    assert f"wrote policy.stablehlo to {out}" in capsys.readouterr().out


@pytest.mark.parametrize("script", ["eval/evaluate.py", "eval/export.py"])
def test_an_unfinished_run_is_refused(fast: None, tmp_path: Path, script: str) -> None:
    run, out = tmp_path / "run", tmp_path / "out"
    loop.start_run(run, CONFIG, SEED)
    module = load(script)
    with pytest.raises(runs.RunError, match=f"0 of {CONFIG.num_iterations} iterations"):
        if script == "eval/export.py":
            module.export_run(run, out, 0)
        else:
            module.evaluate(run, out, 40, (120.0, 50.0), 20)
    assert not out.exists()


def test_the_example_renders_a_camera(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    script, model, picture = load("examples/render_mjcf.py"), tmp_path / "ball.xml", tmp_path / "ball.png"
    model.write_text(BALL)
    monkeypatch.setattr(render, "supersample", functools.partial(draw_small, render.supersample))
    script.main(str(model), "room", str(picture))
    pixels = matplotlib.image.imread(picture)[..., :3]
    assert pixels.shape == (48, 64, 3) and pixels.std() > 0.05


def test_the_model_of_the_example_has_the_camera_of_its_command() -> None:
    model = mujoco.MjModel.from_xml_path(str(ROOT / "examples" / "workshop.xml"))
    assert render.compile_scene(model).geom_ids and model.camera("room").id >= 0


def test_readme_holds_the_results_of_the_committed_runs() -> None:
    script = load("eval/readme_results.py")
    text = script.README.read_text(encoding="utf-8")
    assert text == script.with_sections(text, script.sections()), "run eval/readme_results.py"


def test_the_dynamics_section_compares_both_evaluations_and_says_how_exactly_the_arm_moves() -> None:
    script = load("eval/readme_results.py")
    kinematic, dynamic = (json.loads((script.FOLDER / f"{name}.json").read_text()) for name in ("teapot", "gear"))
    moves = {"planned": 499, "rest_error_micrometre_median": 1.25, "rest_error_micrometre_max": 3.75}
    text = script.dynamics_section(kinematic, dynamic, moves)
    row = next(line for line in text.splitlines() if line.startswith("| rotational error, mean"))
    cells = [tuple(map(float, cell.split("/"))) for cell in row.strip("| ").split(" | ")[1:]]
    wanted = [(kinematic[name]["rotation_error_deg_mean"], dynamic[name]["rotation_error_deg_mean"]) for name in LABELS]
    np.testing.assert_allclose(cells, wanted, atol=0.005001)
    assert "499 random moves" in text and "3.8 µm" in text
    assert "random moves" not in script.dynamics_section(kinematic, dynamic, None)


def test_each_part_is_closed_and_stands_on_the_table(tmp_path: Path) -> None:
    script = load("eval/parts.py")
    for name in script.PARTS:
        mesh = trimesh.load_mesh(script.write_part(name, tmp_path))
        assert mesh.is_watertight and mesh.body_count == 1, name
        assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-4)
        assert 60.0 < mesh.extents.max() < 140.0
