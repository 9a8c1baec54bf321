"""Everything that is measured on an accelerator, in one run: `python eval/gpu.py --out DIR [--quick]`.

For a machine that is at hand for minutes. Each section prints its figures as soon as it has them, and `gpu.json` and
`gpu.md` in DIR are written anew after each row. A section that fails is reported, and the next one runs. `--quick` runs
all sections with small sizes; it takes about two minutes on two CPU cores.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import jax

from gpu_sections import learning, parity, planning, rendering
from gpu_sections.measure import Row, Settings

PACKAGES = ("jax", "jaxlib", "flax", "optax", "brax", "evosax", "mujoco", "mujoco-mjx", "numpy")


class Report:
    """The figures so far, on disk after each row.

    Attributes:
      folder: where `gpu.json` and `gpu.md` are.
      content: what `gpu.json` holds.
      has_failed: whether a section failed.
    """

    def __init__(self, folder: Path, arguments: list[str]) -> None:
        """Makes the folder and notes machine, versions and commit."""
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.has_failed = folder, False
        self.sections: dict[str, dict[str, object]] = {}
        self.content: dict[str, object] = {
            "command": " ".join(["python eval/gpu.py", *arguments]),
            "commit": _commit(),
            "machine": {
                "backend": jax.default_backend(),
                "devices": [device.device_kind for device in jax.devices()],
                "cpu_cores": os.cpu_count(),
                "platform": platform.platform(),
            },
            "versions": {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES},
            "sections": self.sections,
        }
        self.write()

    def run(self, name: str, rows: Callable[[], Iterable[Row]]) -> None:
        """Runs a section; its rows are kept as they come, and its failure is a row too."""
        began, kept = time.perf_counter(), []
        section: dict[str, object] = {"rows": kept}
        self.sections[name] = section
        print(f"\n== {name}", flush=True)
        try:
            for row in rows():
                kept.append(row)
                print("  " + ", ".join(f"{key} {_text(value)}" for key, value in row.items()), flush=True)
                self.write()
        except Exception as error:  # whatever it is, the next section may still tell something
            traceback.print_exc()
            section["error"] = " ".join(str(error).split())[:500] or type(error).__name__
            self.has_failed = True
        section["seconds"] = time.perf_counter() - began
        self.write()

    def write(self) -> None:
        """Writes both files."""
        (self.folder / "gpu.json").write_text(json.dumps(self.content, indent=1) + "\n", encoding="utf-8")
        (self.folder / "gpu.md").write_text(self._markdown(), encoding="utf-8")

    def _markdown(self) -> str:
        machine = self.content["machine"]
        assert isinstance(machine, dict)
        lines = [f"# {', '.join(machine['devices'])}, backend {machine['backend']}", "", f"`{self.content['command']}`"]
        for name, section in self.sections.items():
            rows = section["rows"]
            assert isinstance(rows, list)
            lines += ["", f"## {name}", ""]
            columns = list(dict.fromkeys(key for row in rows for key in row))
            if columns:
                lines += ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
                lines += ["| " + " | ".join(_text(row.get(key)) for key in columns) + " |" for row in rows]
            if "error" in section:
                lines += ["", f"Failed: {section['error']}"]
        return "\n".join(lines) + "\n"


def _text(value: object) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _commit() -> str | None:
    command = ["git", "-C", str(Path(__file__).resolve().parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _train_and_evaluate(report: Report, settings: Settings) -> None:
    trained = []

    def train() -> Iterator[Row]:
        rows, state, config = learning.run_preset("smoke" if settings.is_quick else "gpu", settings)
        trained.append((state, config))
        yield from rows

    report.run("train", train)
    if trained:
        report.run("evaluate", lambda: learning.evaluate(*trained[0]))
    if not settings.is_quick:
        report.run("train, thesis", lambda: learning.run_preset("thesis", settings)[0])


def main(arguments: list[str]) -> int:
    """Runs all sections; returns 1 if one failed or a comparison with the CPU does not hold."""
    parser = argparse.ArgumentParser(description=str(__doc__))
    parser.add_argument("--out", type=Path, required=True, help="folder of gpu.json and gpu.md")
    parser.add_argument("--quick", action="store_true", help="small sizes, for a test on a CPU")
    parser.add_argument("--minutes", type=float, default=6.5, help="time after which no new measurement begins")
    options = parser.parse_args(arguments)
    settings = Settings(options.quick, time.perf_counter() + 60.0 * options.minutes, 0.3 if options.quick else 1.5)
    report = Report(options.out, arguments)
    print(json.dumps(report.content["machine"]), flush=True)
    reference = parity.start_reference(options.out)
    report.run("renderer", lambda: rendering.run(settings))
    report.run("parity with the CPU", lambda: parity.run(settings, reference))
    report.run("IK and RRT-Connect", lambda: planning.run(settings))
    report.run("encoder, environment, SAC", lambda: learning.rates(settings))
    _train_and_evaluate(report, settings)
    reference[0].kill()
    rows = report.sections["parity with the CPU"]["rows"]
    assert isinstance(rows, list)
    broken = [row["what"] for row in rows if not row["holds"]]
    print(f"\nwrote {options.out / 'gpu.json'}" + (f"; does not hold: {broken}" if broken else ""))
    return int(report.has_failed or bool(broken))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
