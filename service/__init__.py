"""The gateway as a web service."""
