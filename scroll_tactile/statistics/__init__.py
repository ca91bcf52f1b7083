"""Exact statistics: integers on a fixed grid, with an algebra of +, − and ==."""
