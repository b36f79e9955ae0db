"""Reading and writing files: atomically, safely from strangers, with numbered formats."""
