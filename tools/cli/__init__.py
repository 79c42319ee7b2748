"""The command line `beamsplat`: one module per command group. Heavy imports happen inside the commands."""
