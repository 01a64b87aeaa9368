"""The pose graph's numbers: edges, optimiser, incremental solver, covariances. It knows no agents and no
maps.
"""
