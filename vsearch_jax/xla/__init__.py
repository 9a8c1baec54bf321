"""What XLA needs and the mathematics does not: lane pool, batch layout, fusion boundary, vectors by coordinate."""
