from pathlib import Path

import numpy as np

from vsearch_jax.runs.metrics_log import MetricsLog, read_metrics


def test_a_resumed_log_drops_lines_of_later_iterations(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path, 0)
    columns = {"stage": np.zeros(6, np.int32), "encoder_loss": np.arange(6.0), "reward": np.full(6, np.nan)}
    log.append(columns, 0, 3.0)
    log.close()
    log = MetricsLog(tmp_path, 4)
    log.append({name: column[4:5] for name, column in columns.items()}, 4, 1.0)
    log.close()
    lines = read_metrics(tmp_path)
    assert [line["iteration"] for line in lines] == [0, 1, 2, 3, 4]
    assert lines[3] == {"iteration": 3, "stage": "encoder", "seconds": 0.5, "encoder_loss": 3.0}
    assert any((tmp_path / "tensorboard").iterdir())
