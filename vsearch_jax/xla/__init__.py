"""Tools that make XLA programs fast: lane pool, batch layout, fusion boundary, operations on pytrees and vectors."""
