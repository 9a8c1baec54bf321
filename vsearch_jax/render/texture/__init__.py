"""Textures: compiled into one atlas, looked up for each pixel."""
