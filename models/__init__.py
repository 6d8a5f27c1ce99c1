"""A machine as mathematics: parameters with unit and source, dynamics, one folder per machine."""
