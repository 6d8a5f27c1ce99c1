"""The C11 that runs on the board, in the emulator and inside the simulator, and its codec."""
