"""What XLA needs and mathematics does not: lane pool, batch layout, fusion boundary."""
