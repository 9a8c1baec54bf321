"""Tests of a run's report: results.json, table, figures, page."""

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.patches import Rectangle
from PIL import Image
from rich.console import Console

from samples import made_up
from vsearch_jax import report
from vsearch_jax.config import Config
from vsearch_jax.report import figures
from vsearch_jax.report.page import CAPTIONS
from vsearch_jax.report.table import table_rows
from vsearch_jax.report.thesis import thesis_range
from vsearch_jax.runs.loop import Evaluated
from vsearch_jax.search import LABELS, POLICIES

CONFIG = Config.preset("smoke")
CONTRACT = {
    "success_rate",
    "success_rate_ci95",
    "pose_success_rate",
    "pose_success_5deg_rate",
    "episodes",
    "evaluations_mean",
    "evaluations_p99",
    "final_cosine_mean",
    "rotation_error_deg_mean",
    "rotation_error_deg_median",
    "translation_error_cm_mean",
    "mssd_cm_mean",
    "false_positive_rate",
    "unreachable_rate",
    "joint_travel_rad_mean",
    "motion_time_s_mean",
    "plans_mean",
}


@pytest.fixture(scope="module")
def evaluated() -> Evaluated:
    return Evaluated(
        arrays=made_up.evaluation(num_seeds=3),
        search=made_up.search(),
        reach=made_up.reach(),
        lines=metrics_lines(),
        wall_seconds={"encoder": 1.5, "policy": 2.5},
        seed=7,
    )


@pytest.fixture(scope="module")
def arrays(evaluated: Evaluated) -> dict[str, Any]:
    return evaluated.arrays


@pytest.fixture(scope="module")
def results(evaluated: Evaluated) -> dict[str, Any]:
    return report.summarize_results(evaluated.arrays, CONFIG, evaluated.wall_seconds)


def metrics_lines() -> list[dict[str, Any]]:
    """Returns lines of metrics.jsonl: 8 encoder updates, then 16 policy iterations."""
    encoder = [{"iteration": i, "stage": "encoder", "seconds": 0.1, "encoder_loss": 1 / (i + 1)} for i in range(8)]
    policy = [
        {"iteration": i, "stage": "policy", "seconds": 0.1, "reward": -1.0 + 0.1 * i, "critic_loss": 1.0, "alpha": 0.1}
        for i in range(8, 24)
    ]
    return [*encoder, *policy]


def test_results_have_the_keys_of_the_contract(results: dict[str, Any]) -> None:
    for name in LABELS:
        assert results[name].keys() >= CONTRACT
    for name in POLICIES:
        wanted = {"steps_lower_bound_mean", "below_bound_rate", "environment_steps", "images_rendered", "seeds"}
        assert results[name].keys() >= wanted
    assert results.keys() >= {"thesis", "config", "commit", "versions", "machine", "wall_seconds"}
    assert [seed["seed"] for seed in results["sac"]["seeds"]] == [0, 1, 2]
    assert all(seed.keys() >= CONTRACT for seed in results["sac"]["seeds"])
    json.dumps(results, allow_nan=False)


def test_results_agree_with_the_arrays(arrays: dict[str, Any], results: dict[str, Any]) -> None:
    ours, raw = results["cma_es"], arrays["cma_es"]
    assert ours["success_rate"] == pytest.approx(raw["is_success"].mean())
    assert ours["evaluations_p99"] == pytest.approx(np.percentile(raw["evaluations"], 99))
    degrees = [math.degrees(error) for error in raw["rotation_error"]]
    assert ours["rotation_error_deg_mean"] == pytest.approx(sum(degrees) / 24, rel=1e-5)
    assert ours["translation_error_cm_mean"] == pytest.approx(100 * raw["translation_error"].mean(), rel=1e-5)
    assert ours["unreachable_rate"] == pytest.approx(raw["unreachable"].sum() / raw["evaluations"].sum())
    for key in ("evaluations_mean", "rotation_error_deg_mean"):
        low, high = ours[f"{key}_ci95"]
        assert low <= ours[key] <= high and low < high
    seeds = results["sac"]["seeds"]
    assert results["sac"]["success_rate"] == pytest.approx(np.mean([seed["success_rate"] for seed in seeds]))
    assert results["sac"]["evaluations_over_lower_bound"] == pytest.approx(4 / 3)


def test_means_of_one_trial_have_no_interval() -> None:
    policy = made_up.trials((1, 1), 5)
    results = report.summarize_results(made_up.evaluation() | {"sac": policy, "sac_assisted": policy}, CONFIG, {})
    assert results["sac"]["evaluations_mean_ci95"] is None
    assert all(len(cells) == len(LABELS) for _, cells in table_rows(results))


def test_an_arm_without_speed_limits_has_no_motion_time(arrays: dict[str, Any]) -> None:
    blank = {name: raw | {"motion_time": np.full_like(raw["motion_time"], np.nan)} for name, raw in arrays.items()}
    results = report.summarize_results(blank, CONFIG, {})
    assert results["sac"]["motion_time_s_mean"] is None
    json.dumps(results, allow_nan=False)
    assert dict(table_rows(results))["motion time, mean (s)"][0].ours == ""


def test_a_search_that_reached_no_view_has_no_mean_cosine(arrays: dict[str, Any]) -> None:
    blank = arrays | {"cma_es": arrays["cma_es"] | {"final_cosine": np.full(24, -np.inf)}}
    results = report.summarize_results(blank, CONFIG, {})
    assert results["cma_es"]["final_cosine_mean"] is None
    json.dumps(results, allow_nan=False)


def test_the_policy_alone_and_with_help_have_rows_of_their_own(results: dict[str, Any]) -> None:
    assert results["sac_assisted"]["helped_rate"] == 0.25
    assert "helped_rate" not in results["sac"]


def test_help_that_was_never_needed_is_reported_as_zero(arrays: dict[str, Any]) -> None:
    never = arrays["sac_assisted"] | {"num_helped": np.zeros_like(arrays["sac_assisted"]["num_helped"])}
    results = report.summarize_results(arrays | {"sac_assisted": never}, CONFIG, {})
    assert results["sac_assisted"]["helped_rate"] == 0.0


def test_what_helps_a_searcher_is_counted(results: dict[str, Any]) -> None:
    assert results["random_search"]["wide_rate"] == pytest.approx(2 / 3)
    assert results["cma_es_restarts"]["restarts_mean"] == pytest.approx(1.0)
    assert results["cma_es_restarts"]["scan_images_mean"] == pytest.approx(21.0)
    assert results["cma_es"].keys() & {"wide_rate", "restarts_mean"} == set()


def test_pose_success_needs_the_threshold_and_the_pose(arrays: dict[str, Any]) -> None:
    degrees = np.tile(np.float32([3.0, 7.0, 20.0, 3.0]), 6)
    is_success = np.tile([True, True, True, False], 6)
    trials = arrays["cma_es"] | {
        "is_success": is_success,
        "rotation_error": np.deg2rad(degrees),
        "is_false_positive": is_success & (degrees > 10.0),
    }
    results = report.summarize_results(arrays | {"cma_es": trials}, CONFIG, {})
    ours = results["cma_es"]
    assert (ours["success_rate"], ours["pose_success_rate"], ours["pose_success_5deg_rate"]) == (0.75, 0.5, 0.25)
    warning = report.false_positive_warning(results)
    assert warning is not None and "CMA-ES 25.0 %" in warning and "Random search" not in warning


def test_no_warning_without_false_positives(arrays: dict[str, Any]) -> None:
    right = {name: raw | {"is_false_positive": np.zeros_like(raw["is_success"])} for name, raw in arrays.items()}
    assert report.false_positive_warning(report.summarize_results(right, CONFIG, {})) is None


def test_table_shows_ours_beside_the_thesis(results: dict[str, Any]) -> None:
    console = Console(width=80, record=True, force_terminal=False)
    report.print_table(results, console)
    text = console.export_text()
    rate = results["random_search"]["success_rate"]
    assert re.search(rf"success by cosine \(%\).* {100 * rate:.2f} .*–.* 95\.00 ", text)
    assert "40.00–60.00" in text
    assert "…" not in text  # rich cuts a cell that is too wide with "…"
    assert "SAC alone, seed 2" in text


def test_report_writes_results_figures_and_one_page(tmp_path: Path, evaluated: Evaluated) -> None:
    results = report.write_report(tmp_path, evaluated, CONFIG)
    assert (results["seed"], results["symmetry"]) == (7, 1)
    assert json.loads((tmp_path / "results.json").read_text()) == json.loads(json.dumps(results))
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(CAPTIONS) == 8
    assert "http" not in page
    assert {path.stem for path in (tmp_path / "figures").iterdir()} == set(CAPTIONS)
    for name in CAPTIONS:
        with Image.open(tmp_path / "figures" / f"{name}.png") as image:
            assert min(image.size) > 200
            assert np.asarray(image.convert("L")).std() > 5, f"{name} is blank"


def test_figures_can_be_drawn_for_a_run_that_found_nothing(evaluated: Evaluated) -> None:
    nothing: dict[str, Any] = {
        name: values | {"is_success": np.zeros_like(values["is_success"])} for name, values in evaluated.arrays.items()
    }
    results = report.summarize_results(nothing, CONFIG, {})
    no_reach = dataclasses.replace(made_up.reach(), is_reachable=jnp.zeros((12, 7), bool))
    failed = evaluated._replace(arrays=nothing, reach=no_reach, lines=[])
    pictures = report.draw_figures(results, failed, CONFIG)
    assert set(pictures) == set(CAPTIONS)
    for picture in pictures.values():
        picture.canvas.draw()
        assert picture.axes


def test_search_strip_shows_every_step_and_the_target() -> None:
    images = np.linspace(0, 1, 4 * 8 * 8 * 3, dtype=np.float32).reshape(4, 8, 8, 3)
    picture = report.draw_search_strip(images, [0.1, 0.5, 0.9, 0.99], images[0])
    assert [axes.get_xlabel() for axes in picture.axes] == [
        "start: 0.100",
        "step 1: 0.500",
        "step 2: 0.900",
        "step 3: 0.990",
        "target",
    ]


def test_a_range_of_the_thesis_is_drawn_from_its_lowest_to_its_highest_value(results: dict[str, Any]) -> None:
    panels = figures.draw_comparison(results).axes
    images = next(axes for axes in panels if axes.get_title(loc="left") == "images or steps, mean")
    bars = {round(bar.get_x() + bar.get_width() / 2, 3): bar for bar in images.patches if isinstance(bar, Rectangle)}
    num_ranges = 0
    for position, name in enumerate(LABELS):
        published = thesis_range(name, "evaluations_mean")
        if published is None:
            assert round(position + 0.2, 3) not in bars
            continue
        bar, (low, high) = bars[round(position + 0.2, 3)], published
        num_ranges += low < high
        wanted = (low, high) if low < high else (0.0, high)
        assert (bar.get_y(), bar.get_y() + bar.get_height()) == pytest.approx(wanted)
    assert num_ranges > 0


def test_the_last_bar_of_a_histogram_says_what_it_holds() -> None:
    trials = made_up.trials((1, 400), 5)
    degrees = np.rad2deg(trials["rotation_error"])
    drawn = figures.draw_policy_episodes(trials | {"steps_lower_bound": np.full((1, 400), 3)})
    label = drawn.axes[1].get_xlabel()
    assert f"above {np.percentile(degrees, 99):.3g}, up to {degrees.max():.3g}" in label
