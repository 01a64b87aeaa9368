"""Rooms from seeds: layout, pictures, light, free space; and users' own glTF rooms."""
