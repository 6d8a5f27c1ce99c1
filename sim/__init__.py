"""The MuJoCo plant with the firmware compiled in, the simulated network, closed loop."""
