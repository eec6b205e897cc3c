"""Pictures for people: plots, flights, videos."""
