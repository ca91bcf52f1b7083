"""Answers written back to where the readings came from: frame by frame into LeRobot data sets, and as MCAP channels."""
