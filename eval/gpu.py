"""Measures everything on an accelerator in one run: `python eval/gpu.py --out DIR [--quick]`.

For a machine that is at hand for minutes. Each section prints its figures as soon as it has them. The files `gpu.json`
and `gpu.md` in DIR are written anew after each row. A section that fails is reported, and the next section runs.
`--quick` runs all sections with small sizes, as a test on a CPU.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import os
import platform
import sys
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path

if "--quick" in sys.argv:  # Nearly all the time of a quick run goes to compilation. Set before jax is imported.
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=1")
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".cache" / "jax"))

import jax

import vsearch_jax as vs
from gpu_sections import learning, parity, planning, rendering
from gpu_sections.measure import Row, Settings
from vsearch_jax.cli.errors import one_line_errors
from vsearch_jax.report.provenance import commit
from vsearch_jax.runs.atomic import write_atomically
from vsearch_jax.types import TrainState

PACKAGES = ("vsearch_jax", "jax", "jaxlib", "flax", "optax", "brax", "evosax", "mujoco", "mujoco-mjx", "numpy")
SECTIONS = ("parity", "train", "evaluate", "renderer", "planning", "rates", "thesis")


class Report:
    """The figures so far, on disk after each row.

    Attributes:
      folder: where `gpu.json` and `gpu.md` are.
      content: what `gpu.json` holds, but for the sections.
      sections: rows, seconds and error of each section.
    """

    def __init__(self, folder: Path, command: str, commit: str | None) -> None:
        """Makes the folder and notes machine, versions and commit."""
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.sections: dict[str, dict[str, object]] = {}
        self.machine: dict[str, object] = {
            "backend": jax.default_backend(),
            "devices": [device.device_kind for device in jax.devices()],
            "cpu_cores": os.cpu_count(),
            "platform": platform.platform(),
        }
        versions = {"python": platform.python_version()} | {name: _version(name) for name in PACKAGES}
        self.content = {"command": command, "commit": commit, "machine": self.machine, "versions": versions}
        self.write()

    def run(self, name: str, rows: Callable[[], Iterable[Row]]) -> None:
        """Runs a section. Its rows are kept as they come, and a failure is noted."""
        began = time.perf_counter()
        kept: list[Row] = []
        section: dict[str, object] = {"rows": kept}
        self.sections[name] = section
        print(f"\n== {name}", flush=True)
        try:
            for row in rows():
                kept.append({key: _without_nan(value) for key, value in row.items()})
                print("  " + ", ".join(f"{key} {_text(value)}" for key, value in row.items()), flush=True)
                self.write()
        except Exception as error:  # Whatever failed, the next section can still give figures.
            traceback.print_exc()
            section["error"] = " ".join(str(error).split())[:500] or type(error).__name__
        section["seconds"] = time.perf_counter() - began
        self.write()

    def write(self) -> None:
        """Writes both files."""
        content = self.content | {"sections": self.sections}
        write_atomically(self.folder / "gpu.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
        write_atomically(self.folder / "gpu.md", self._markdown())

    def failures(self) -> list[str]:
        """Returns the sections that failed and the comparisons with the CPU that do not hold."""
        failed = [name for name, section in self.sections.items() if "error" in section]
        for section in self.sections.values():
            rows = section["rows"]
            assert isinstance(rows, list)
            failed += [row["what"] for row in rows if row.get("holds") is False]
        return failed

    def _markdown(self) -> str:
        lines = [f"# {self.machine['devices']}, backend {self.machine['backend']}", "", f"`{self.content['command']}`"]
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


def _without_nan(value: str | int | float | bool | None) -> str | int | float | bool | None:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _text(value: object) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def run_sections(report: Report, names: list[str], settings: Settings) -> None:
    """Runs the named sections; each may use a share of the time that is left when it begins."""
    trained: list[tuple[TrainState, vs.Config]] = []
    reference = parity.start_reference(report.folder, settings.is_quick) if "parity" in names else None
    sections: dict[str, Callable[[], Iterable[Row]]] = {
        "parity": lambda: parity.run(settings.share(0.3), reference) if reference else [],
        "train": lambda: learning.train("gpu", settings.share(0.4), trained),
        "evaluate": lambda: learning.evaluate(settings.share(0.2), trained),
        "renderer": lambda: rendering.run(settings.share(0.4)),
        "planning": lambda: planning.run(settings.share(0.5)),
        "rates": lambda: learning.rates(settings.share(0.6), trained),
        "thesis": lambda: learning.train("thesis", settings, []),
    }
    for name in names:
        if settings.seconds_left < 20.0 and not settings.is_quick:
            report.run(name, lambda: [{"what": "not run: out of time"}])
        else:
            report.run(name, sections[name])
    if reference:
        reference[0].kill()


def main(arguments: list[str]) -> int:
    """Runs the sections; returns 1 if one failed or a comparison with the CPU does not hold."""
    parser = argparse.ArgumentParser(description="Measures an accelerator and compares it with the CPU.")
    parser.add_argument("--out", type=Path, required=True, help="folder of gpu.json and gpu.md")
    parser.add_argument("--quick", action="store_true", help="small sizes and no limit of time, for a test on a CPU")
    parser.add_argument("--minutes", type=float, default=6.5, help="time after which no new measurement begins")
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, help="which sections; all by default")
    parser.add_argument("--commit", help="commit to note, where the folder is no git checkout")
    options = parser.parse_args(arguments)
    minutes = math.inf if options.quick else options.minutes
    settings = Settings(options.quick, time.perf_counter() + 60.0 * minutes, 0.2 if options.quick else 1.5)
    # A quick run trains the same preset in both sections.
    names = options.sections or [name for name in SECTIONS if not (options.quick and name == "thesis")]
    report = Report(options.out, " ".join(["python eval/gpu.py", *arguments]), options.commit or commit())
    print(json.dumps(report.machine), flush=True)
    run_sections(report, names, settings)
    failures = report.failures()
    print(f"\nwrote {options.out / 'gpu.json'}" + (f"; failed: {failures}" if failures else ""))
    return int(bool(failures))


if __name__ == "__main__":
    with one_line_errors():
        sys.exit(main(sys.argv[1:]))
