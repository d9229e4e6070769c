"""Who may use how much of the server: budgets of identities, promised worker time, cameras."""
