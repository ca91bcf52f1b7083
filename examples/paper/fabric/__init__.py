"""What fabrics are made of: the paper's third task, on a published layout or on simulated fabrics."""
