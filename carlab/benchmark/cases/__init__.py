"""Cases with concealed physics: recordings, nominal car file and the sealed answer."""
