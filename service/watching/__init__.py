"""What tells of the gateway: logs, metrics, traces."""
