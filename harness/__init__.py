"""Scenario, wiring, clocks, step loop, sensors, records, metrics, campaigns, command line."""
