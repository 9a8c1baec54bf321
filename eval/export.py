"""Writes encoder and policy of a finished run as StableHLO files, by the Python API: an example to copy.

python eval/export.py runs/first --out deploy --policy 0
"""

from __future__ import annotations

import argparse
from pathlib import Path

from vsearch_jax import runs
from vsearch_jax.cli.errors import one_line_errors
from vsearch_jax.export.stablehlo import export


def export_run(run: Path, out: Path, policy: int) -> None:
    """Exports the last checkpoint.

    Args:
      run: folder of a finished run.
      out: folder of the files; must be empty or not exist.
      policy: which of the run's policies.
    """
    config = runs.read_config(run)
    state = runs.resume_run(run, config)
    runs.check_finished(run, state, config)
    runs.make_new_folder(out)
    export(out, state, config, policy)
    print(f"wrote {', '.join(sorted(path.name for path in out.iterdir()))} to {out}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Exports a finished run.")
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--out", type=Path, required=True, help="folder of the files")
    parser.add_argument("--policy", type=int, default=0, help="which of the run's policies")
    options = parser.parse_args()
    with one_line_errors():
        export_run(options.run, options.out, options.policy)
