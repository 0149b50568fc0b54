"""Pictures in files: all reading and writing of them."""

from btfref.images.files import load_image, save_image

__all__ = ["load_image", "save_image"]
