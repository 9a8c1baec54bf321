"""A trained encoder and policy as files that run without this package."""
