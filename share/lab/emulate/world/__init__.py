"""Rooms as seeded data: layout, pictures, light, where one can move, users' own glTF rooms."""
