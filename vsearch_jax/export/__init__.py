"""Files of a trained encoder and policy that run without this package."""
