"""Limits on the use of the server: budgets of identities, promised worker time, active cameras."""
