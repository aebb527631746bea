"""Files of others into recordings and maps."""
