"""Rays, level sets and triangles: what each pixel hits."""
