"""What a fleet needs of gateways, worked out from what a load test measured."""
