"""The thesis's evaluation of a run, its table and figures: `python eval/thesis.py runs/first`."""

import sys

from vsearch_jax.cli.main import main

if __name__ == "__main__":
    main(["eval", *sys.argv[1:]])
