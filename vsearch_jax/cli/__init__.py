"""The `vsearch` command."""
