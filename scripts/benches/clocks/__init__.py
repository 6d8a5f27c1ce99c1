"""What scripts/benches/sync.py is made of."""
