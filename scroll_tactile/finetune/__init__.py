"""Fine-tuning: the optional pass over the exemplars that makes f*."""
