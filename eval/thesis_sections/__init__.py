"""The parts of `eval/thesis.py`: published values, searches, the thesis's policy, figures and tables."""
