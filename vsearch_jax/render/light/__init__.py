"""Lights, shadows and shading."""
