"""The sections of `eval/gpu.py`: each is a function from `Settings` to rows of figures."""
