"""What was learned: state, rows, identity, exemplars, kept touches, descriptions and the tuned model."""
