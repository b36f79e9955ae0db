"""GIRIL and the methods it is compared with, as TorchRL parts and recipes."""
