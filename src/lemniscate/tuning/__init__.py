"""The search for the settings with which an algorithm learns an environment best."""
