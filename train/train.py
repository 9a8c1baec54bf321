"""One run, from a preset to a checkpoint and a report: `python train/train.py --preset cpu --out runs/first`."""

import sys

from vsearch_jax.cli.main import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
