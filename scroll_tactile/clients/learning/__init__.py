"""Pipelines: thin clients of the learner."""
