"""How large an uplink has to be: measured tables, and what follows of them."""
