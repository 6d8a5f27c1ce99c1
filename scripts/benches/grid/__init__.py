"""The optimal control problem of one tick, solved by us and by acados in the same closed loop."""
