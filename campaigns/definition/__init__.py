"""What a campaign is: its file as read and checked, each case's parameters, and the identity of it all."""
