"""What each ray hits: ray functions of the primitives, their level sets, triangles and the rasteriser."""
