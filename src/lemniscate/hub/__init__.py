"""The Hugging Face Hub, and whose code may be imported."""
