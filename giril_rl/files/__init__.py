"""Files: atomic writing, and reading that cannot run code or fill the memory."""
