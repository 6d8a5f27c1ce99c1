"""What a run leaves: run.mcap, written while it runs by a process of its own."""
