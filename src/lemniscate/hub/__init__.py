"""The Hugging Face Hub: download, upload, and whose code may be imported."""
