"""The twin in a browser: fields as splats, cameras as they move, pictures as they arrive."""
