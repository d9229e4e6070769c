"""What pictures show beside a field: objects, contacts with the ground, views composed of both."""
