"""Everything around the processes: command line, supervision, set-up, evaluation, benchmarks, simulator."""
