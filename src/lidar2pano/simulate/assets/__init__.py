"""What a street is made of: houses, plants, vehicles, people, signs and street furniture, as meshes."""
