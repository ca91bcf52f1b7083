"""A memory as tools for planners, over the Model Context Protocol."""
