"""What runs every tick, in calling order: estimator, mpc, tracks, gains, loop."""
