"""Comparing a touch with kept touches: the likeliest noise, a log-likelihood of each material, and conformal sets."""
