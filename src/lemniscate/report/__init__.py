"""What people look at: plots, flights, videos."""
