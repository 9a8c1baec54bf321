"""Textures: the atlas of texels, and their lookup at each pixel."""
