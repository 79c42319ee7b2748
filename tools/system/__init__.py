"""The run-time system: checking of deployments, supervision of processes, hand-over, health."""
