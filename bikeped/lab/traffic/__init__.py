"""Real or recorded traffic through tracker and rules: nuisance and misses."""
