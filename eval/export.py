"""Encoder and policy of a run as StableHLO files: `python eval/export.py runs/first --out deploy`."""

import sys

from vsearch_jax.cli.main import main

if __name__ == "__main__":
    main(["export", *sys.argv[1:]])
