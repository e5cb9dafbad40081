"""Deployment gates, promotion, what-if comparison, risk register, audit records."""
