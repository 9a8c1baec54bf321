"""The parts of `eval/encoders.py`: training of one encoder, the images it is measured on, and the measures."""
