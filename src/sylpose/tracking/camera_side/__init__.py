"""What one camera does with its own images: it sends the other cameras numbers only (`tracking.reports`)."""
