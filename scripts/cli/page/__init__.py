"""The page that a run is looked at with: one HTML file that needs nothing else."""
