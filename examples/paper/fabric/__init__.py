"""What fabrics are made of: the paper's third task, on simulated fabrics, and on real data that stand in for them."""
