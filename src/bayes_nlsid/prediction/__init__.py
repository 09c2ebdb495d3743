"""What a posterior says about responses: backbone bands and held-out records."""
