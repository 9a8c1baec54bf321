import resource
from pathlib import Path

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

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


def read_events(folder: Path) -> list[Event]:
    """Reads the only file of events in a folder; each has 12 bytes before and 4 bytes after it."""
    (path,) = folder.iterdir()
    data, events = path.read_bytes(), []
    while data:
        length = int.from_bytes(data[:8], "little")
        events.append(Event.FromString(data[12 : 12 + length]))
        data = data[16 + length :]
    return events


def test_events_hold_every_metric(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path, 4)
    log.append({"stage": np.array([0, 1]), "reward": np.array([np.nan, 0.5])}, 4, 3.0)
    log.close()
    version, start, *events = read_events(tmp_path / "tensorboard")
    assert version.file_version == "brain.Event:2" and (start.step, start.session_log.status) == (4, 1)
    found = {(event.step, value.tag): value.simple_value for event in events for value in event.summary.value}
    assert found == {(4, "encoder/seconds"): 1.5, (5, "policy/seconds"): 1.5, (5, "policy/reward"): 0.5}


def test_a_full_disk_is_an_exception_also_for_events(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path, 0)
    columns = {"stage": np.zeros(40, np.int32), "encoder_loss": np.arange(40.0)}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4_000, limits[1]))  # The lines have 3,000 bytes, the events 5,000.
    try:
        with pytest.raises(OSError, match="File too large"):
            log.append(columns, 0, 1.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    log.close()
    assert len(read_metrics(tmp_path)) == 40
