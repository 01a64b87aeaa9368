"""Furniture, one family a file, from boxes, cylinders and simple meshes.

Every function returns a `Shape` in its own frame: x to the right as seen from its front, the front
towards -y, its back in the plane y = 0, standing on z = 0, the middle at x = 0; metres. Each takes a
seeded generator for sizes, wear, small objects and pictures.
"""
