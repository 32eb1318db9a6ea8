"""The command line, the process table, the supervisor and the scenario model."""
