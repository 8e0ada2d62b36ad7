#version 330 core
// Vertex shader of the pinhole views; its name and its uniforms are those of pyrender's shader for segmentation.
layout(location = 0) in vec3 position;
uniform mat4 V;
uniform mat4 P;
flat out vec4 number;

void main()
{
    // mat4() prevents the compiler from reordering the products, which would change the rounding
    gl_Position = mat4(P * V) * vec4(position, 1.0);
    // the vertex number in 24 bits, least significant byte first; a triangle has the number of its last vertex
    number = vec4(gl_VertexID & 255, (gl_VertexID >> 8) & 255, (gl_VertexID >> 16) & 255, 0) / 255.0;
}
