"""Links made by the kernel: a network namespace per agent, its rate by `tc tbf`. Needs root."""
