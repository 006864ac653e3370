"""What people take home: clouds (las), pictures."""
