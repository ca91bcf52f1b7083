"""What is built on the learner: each of these rooms could go without the others noticing."""
