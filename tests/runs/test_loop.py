from pathlib import Path

import numpy as np
import pytest

from vsearch_jax.config import Config
from vsearch_jax.runs import loop
from vsearch_jax.runs.folder import RunError


@pytest.mark.parametrize(
    ("name", "row", "field"),
    [
        ("encoder_loss", 2, "EncoderConfig.learning_rate"),
        ("reward", 9, "SACConfig.learning_rate"),
        ("actor_loss", 20, "SACConfig.learning_rate"),
        ("critic_loss", 20, "SACConfig.learning_rate"),
    ],
)
def test_a_diverged_run_is_stopped(tmp_path: Path, name: str, row: int, field: str) -> None:
    config = Config.preset("smoke")  # 8 encoder updates, 4 policy iterations of warm-up, 12 with updates
    number = np.arange(config.num_iterations)
    first_iteration = {"encoder_loss": 0, "reward": 8, "actor_loss": 12, "critic_loss": 12}
    columns = {key: np.where(number >= first, 1.0, np.nan) for key, first in first_iteration.items()}
    columns["stage"] = (number >= 8).astype(np.int32)
    loop.check_finite(tmp_path, columns, 0, config)
    columns[name][row] = np.nan
    with pytest.raises(RunError, match=f"{name} is not finite .* smaller {field}"):
        loop.check_finite(tmp_path, columns, 0, config)
