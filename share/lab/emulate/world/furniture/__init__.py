"""Furniture, one family a file, from boxes, cylinders and simple meshes.

Every function answers a `Shape` in the frame of the thing itself: x to the right as one looks at its
front, the front towards -y, its back in the plane y = 0, standing on z = 0, the middle at x = 0; metres.
Each takes a seeded generator: sizes, wear, what lies on it and which pictures it wears come from there.
"""
