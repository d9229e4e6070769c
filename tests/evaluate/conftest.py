from thumbnail import thumbnail

__all__ = ["thumbnail"]
