"""The command `vsearch`."""
