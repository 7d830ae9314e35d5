"""Dagster wiring: definitions, jobs, schedules, partitions, executors."""
