"""Speed against error: exact sums beside recursive, QR and plain ones, on cases that are hard."""
