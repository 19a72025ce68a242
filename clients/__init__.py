"""Clients of the gateway over HTTP: a typed client, a simulated fleet, a load test."""
