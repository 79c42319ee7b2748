"""Nodes and their runners (live processes, lockstep in one thread); mailboxes, jobs, health, hand-over."""
