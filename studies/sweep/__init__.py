"""Studies of many runs: a file names them, cells are run side by side, a table keeps what came."""
