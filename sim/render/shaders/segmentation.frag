#version 330 core
// Fragment shader of the pinhole views: the number of the triangle's last vertex as a colour.
flat in vec4 number;
out vec4 colour;

void main()
{
    colour = number;
}
