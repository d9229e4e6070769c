"""The fields a server holds: opened for rendering, published by tile, handed out to vehicles."""
