"""The run-time system: deployments checked and assembled, processes supervised, handed over, watched."""
