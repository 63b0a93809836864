"""Numerical methods, arrays in and answers out: PDHG, projections, interior points, matrix games, block Cholesky.

Nothing here knows what an MDP is.
"""
