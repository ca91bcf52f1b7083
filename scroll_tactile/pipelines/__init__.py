"""Clients of the learner: a demonstration, replays of recorded sets, and the proof that schedules do not matter."""
